# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reproduce the paper with one command, from a local server, with the demo's room and networks."""

import csv
import fcntl
import io
import json
import re
import subprocess
import sys
import tarfile
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

from cliploc_ros.cli import build_map, evaluate
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_frames
from cliploc_ros.offline.datasets.bag_poses import PoseSource
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from demo import ASSETS
from demo import __main__ as demo
from studies import reproduce

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
SHIPPED = yaml.safe_load((PROJECT / 'studies/reproduce.yaml').read_text())
NETWORKS = ('yolo.onnx', 'clip.json', 'clip.safetensors')
ARCHIVE = 'rgbd_dataset_freiburg3_demo.tgz'


class Handler(BaseHTTPRequestHandler):
    """Sends files or their remaining parts."""

    def do_GET(self):
        server, name = self.server, self.path.strip('/')
        server.asked.append((name, self.headers.get('Range')))
        content = server.files.get(name)
        if content is None:
            self.send_error(404)
            return
        start = int(re.fullmatch(r'bytes=(\d+)-', self.headers.get('Range', 'bytes=0-'))[1])
        if start >= len(content):
            self.send_error(416)
            return
        self.send_response(206 if start else 200)
        self.send_header('Content-Length', str(len(content) - start))
        if start:
            self.send_header('Content-Range', f'bytes {start}-{len(content) - 1}/{len(content)}')
        self.end_headers()
        self.wfile.write(content[start:])

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture
def server():
    """Serves the demo's networks, and one of its walks as a sequence of TUM RGB-D."""
    with ThreadingHTTPServer(('127.0.0.1', 0), Handler) as serving:
        serving.files = {name: (ASSETS / name).read_bytes() for name in NETWORKS}
        content = io.BytesIO()
        with tarfile.open(fileobj=content, mode='w:gz', compresslevel=1) as archive:
            archive.add(ASSETS / 'mapping', 'rgbd_dataset_freiburg3_demo')
        serving.files[ARCHIVE] = content.getvalue()
        serving.asked = []
        threading.Thread(target=serving.serve_forever, args=(0.05,), daemon=True).start()
        yield serving
        serving.shutdown()


@pytest.fixture
def write_sources(server, tmp_path):
    """Write sources on the server with changes of the sequence; return the file."""
    def write(**changes):
        sources = yaml.safe_load(Path(__file__).with_name('sources.yaml').read_text().replace(
            'ADDRESS', f'http://127.0.0.1:{server.server_port}'))
        sources['sequences']['fr3'] |= {'paper': SHIPPED['sequences']['fr3']['paper'], **changes}
        file = tmp_path / 'sources.yaml'
        file.write_text(yaml.safe_dump(sources, allow_unicode=True))
        return file
    return write


@pytest.fixture
def refused(run_here):
    """Run in this process, and return the single line of the error."""
    def run(*arguments):
        done = run_here(reproduce.main, 'fr3', *arguments)
        assert done.returncode == 1
        line, = (line for line in done.stderr.splitlines() if line.startswith('error: '))
        return line
    return run


def test_a_run_that_was_interrupted_goes_on(server, write_sources, run_here, tmp_path):
    out, content = tmp_path / 'out', server.files[ARCHIVE]
    (out / 'downloads').mkdir(parents=True)
    (out / 'downloads' / f'{ARCHIVE}.partial').write_bytes(content[:10_000])
    arguments = ('fr3', '--yes', '--trials', 2, '--sources', write_sources(), '--out', out)
    done = run_here(reproduce.main, *arguments)
    assert done.returncode == 0, done.stderr
    assert (ARCHIVE, 'bytes=10000-') in server.asked
    assert (out / 'downloads' / ARCHIVE).read_bytes() == content
    check_results(out, done.stdout)
    asked, before = len(server.asked), (out / 'fr3/map.yaml').stat().st_mtime_ns
    again = run_here(reproduce.main, *arguments)
    assert again.returncode == 0 and (out / 'fr3/map.yaml').stat().st_mtime_ns == before
    assert len(server.asked) == asked, 'all was there'
    other = run_here(reproduce.main, *arguments, '--trials', 3)
    assert other.returncode == 1 and 'was begun with other --sources or --trials' in other.stderr


def check_results(out, printed):
    text = (out / 'table.txt').read_text()
    assert text in printed
    row = next(line for line in text.splitlines() if re.match('hybrid +b-prosac', line))
    assert row.split()[-3:] == ['0.72±0.0283', '0.983±0.0638', '0.926±0.226']
    with (out / 'table.csv').open() as file:
        rows = {row['method']: row for row in csv.DictReader(file)}
    assert (*rows,) == (*PAPER_METHODS, 'auto')
    assert (rows['clip_bf']['paper_success'], rows['auto']['paper_success']) == ('0.68', '')
    assert (out / 'table.tex').read_text().count(r' \\') == 1 + len(rows)
    assert (out / 'page.html').read_text().count('src="data:image/png;base64,') == 3
    with tarfile.open(out / 'results.tar') as archive:
        names = archive.getnames()
        about = json.load(archive.extractfile('reproduction/about.json'))
    assert names == [f'reproduction/{name}' for name in (
        'table.txt', 'table.csv', 'table.tex', 'page.html', 'about.json', 'fr3/map.yaml',
        'fr3/evaluation/results.json', 'fr3/evaluation/summary.csv')]
    assert set(about['digests']) == {ARCHIVE, *NETWORKS}


def test_it_says_what_it_downloads_and_asks(server, write_sources, run_here, tmp_path,
                                            monkeypatch):
    given = ('fr3', '--sources', write_sources(), '--out', tmp_path / 'out')
    monkeypatch.setattr(sys, 'stdin', io.StringIO('n\n'))
    done = run_here(reproduce.main, *given)
    assert done.returncode == 1 and 'nothing was downloaded' in done.stdout
    for said in (f'/{ARCHIVE}', 'Apache-2.0', '10 MB to download', 'No frame of this is real.'):
        assert said in done.stdout
    done = run_here(reproduce.main, *given)  # the input has ended
    assert done.returncode == 1 and 'give --yes' in done.stderr
    assert run_here(reproduce.main, *given, '--ask').returncode == 1, 'the script installs nothing'
    assert run_here(reproduce.main, *given, '--yes', '--ask').returncode == 0
    planned = run_here(reproduce.main, *given[:-1], tmp_path / 'other', '--plan')
    assert planned.returncode == 0 and 'to download' in planned.stdout
    assert not server.asked and not (tmp_path / 'other').exists()


def test_what_cannot_be_downloaded(server, write_sources, refused, tmp_path):
    given = ('--yes', '--sources', write_sources(sha256='0' * 64), '--out', tmp_path / 'out')
    weights = server.files.pop('yolo.onnx')
    said = refused(*given)
    assert 'cannot download' in said and '404' in said and 'Check network and address' in said
    server.files['yolo.onnx'] = weights
    # The server's file is now shorter than the part downloaded from an older one.
    part = tmp_path / 'out/downloads/yolo.onnx.partial'
    part.write_bytes(bytes(len(weights) + 1))
    assert '416' in refused(*given)
    assert not part.exists()
    said = refused(*given)
    assert f'expected {"0" * 64}' in said and f'kept as {ARCHIVE}.refused' in said
    # a digest that was unknown at first is compared later
    (tmp_path / 'out/downloads/yolo.onnx').write_bytes(b'something else')
    assert 'yolo.onnx has SHA-256' in refused(*given)
    assert not (tmp_path / 'out/downloads/yolo.onnx').exists()
    server.files[ARCHIVE] = server.files[ARCHIVE][:-1000]
    said = refused('--yes', '--sources', write_sources(), '--out', tmp_path / 'other')
    assert 'cannot be unpacked' in said and 'run again to download it' in said


def test_a_disk_that_is_too_small_and_another_run(write_sources, refused, tmp_path):
    given = ('--yes', '--out', tmp_path / 'out', '--sources')
    assert 'GB are needed: make room, or set --out to another disk' in refused(
        *given, write_sources(megabytes=1e9))
    (tmp_path / 'out').mkdir(exist_ok=True)
    with (tmp_path / 'out/.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert 'another run is at work' in refused(*given, write_sources())


def test_the_demo_wakes_up_in_a_recording_that_it_downloads(server, write_sources, run_here,
                                                            tmp_path, monkeypatch):
    given = ('--real', '--assets', ASSETS, '--sources', write_sources(), '--out', tmp_path / 'out',
             '--method', 'class_auto', '--wake-ups', '1')
    monkeypatch.setattr(sys, 'stdin', io.StringIO('n\n'))
    done = run_here(demo.main, *given)
    assert done.returncode == 1 and 'nothing was downloaded' in done.stdout and not server.asked
    assert f'/{ARCHIVE}' in done.stdout and 'Apache-2.0' in done.stdout
    archive = server.files.pop(ARCHIVE)
    done = run_here(demo.main, *given, '--yes')  # the file to bring is named
    file = tmp_path / 'out/real/downloads' / ARCHIVE
    assert done.returncode == 1 and f'put the file there yourself, as {file}' in done.stderr
    file.write_bytes(archive)
    done = subprocess.run([sys.executable, '-m', 'demo', *given, '--yes'], cwd=PROJECT,
                          capture_output=True, text=True)
    assert done.returncode == 0 and '1 wake-ups: 1 accepted, 0 refused, none wrong' in done.stdout
    page = (tmp_path / 'out/index.html').read_text()
    assert 'These images are real:</b> the demo, Apache-2.0.' in page
    assert 'synthetic' not in page and 'equal in 1 of 1 cases' in page


def test_sources_that_lack_something(write_sources, refused):
    file = write_sources()
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | {'sequences': {}}))
    assert 'has no sequence fr3' in refused('--sources', file)
    file.write_text('networks: []\nsequences: {fr2: {name: a}}\n')
    assert 'is not like reproduce.yaml' in refused('--sources', file)


def test_seven_scenes_is_an_archive_in_an_archive(shared_data, tmp_path):
    frames = sorted((shared_data / 'seven_scenes_kitchen').glob('frame-*'))[:30]
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, 'w') as archive:
        for file in frames:
            archive.write(file, f'seq-01/{file.name}')
    (tmp_path / 'downloads').mkdir()
    with zipfile.ZipFile(tmp_path / 'downloads/kitchen.zip', 'w') as archive:
        archive.writestr('kitchen/seq-01.zip', inner.getvalue())
    one = reproduce.Recording(
        name='', url='http://127.0.0.1:9/kitchen.zip', megabytes=1, licence='', unpacked=1,
        queries=3, inner='kitchen/seq-01.zip')
    folder = reproduce.unpacked(one, tmp_path, tmp_path)
    assert folder == tmp_path / 'frames/seq-01'
    reproduce.write_bags(one, folder, tmp_path)
    stamps = [[raw.stamp_ns for raw in bag_frames(
        tmp_path / name, BagTopics('/image/compressed', '/camera_info'),
        PoseSource(tolerance_ns=0)).read_raw(lambda *_: True)]
        for name in ('mapped', 'asked')]
    assert [len(some) for some in stamps] == [5, 3]
    assert not set(stamps[0]) & set(stamps[1])


def packed(name, content):
    """Return a tgz with one file."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode='w:gz') as archive:
        member = tarfile.TarInfo(name)
        member.size = len(content)
        archive.addfile(member, io.BytesIO(content))
    return packed.getvalue()


def zipped(**members):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return packed.getvalue()


# The identifiers are words: a packed file holds the time of day, and so would its identifier.
@pytest.mark.parametrize(('file', 'content', 'inner', 'said'), [
    pytest.param('a.zip', zipped(**{'../a': 'x', '/b': 'x'}), '', 'none of its members',
                 id='zip-outside'),
    pytest.param('a.zip', zipped(), '', 'none of its members', id='zip-empty'),
    pytest.param('a.tgz', packed('../a', b''), '', 'outside', id='tar-outside'),
    pytest.param('a.tgz', packed('a', bytes(3_000_000)), '', 'more than 2 MB', id='tar-large'),
    pytest.param('a.zip', zipped(a=bytes(3_000_000)), '', 'more than 2 MB', id='zip-large'),
    pytest.param('a.zip', zipped(b=bytes(3_000_000)), 'b', 'more than 2 MB', id='member-large'),
    pytest.param('a.zip', zipped(**{'b.zip': zipped(a=bytes(3_000_000))}), 'b.zip',
                 'more than 2 MB', id='inner-zip-large')])
def test_an_archive_without_sound_members_or_of_any_size_is_named(file, content, inner, said,
                                                                  tmp_path):
    (tmp_path / 'downloads').mkdir()
    (tmp_path / 'downloads' / file).write_bytes(content)
    one = reproduce.Recording(name='', url=f'http://127.0.0.1:9/{file}', megabytes=1, licence='',
                              unpacked=1, queries=3, inner=inner)
    with pytest.raises(DatasetError, match=f'cannot be unpacked .*{said}'):
        reproduce.unpacked(one, tmp_path, tmp_path)
    assert [*(path for path in tmp_path.rglob('*') if path.is_file())] == []


def test_the_form_of_the_shipped_sources():
    """The addresses cannot be opened here."""
    sources = reproduce.Sources.of_file(PROJECT / 'studies/reproduce.yaml')
    assert (*sources.recordings,) == ('fr2', 'fr3', 'kitchen', 'fr1')
    for download in (*sources.networks, *sources.recordings.values()):
        assert download.url.startswith('https://')
        assert re.fullmatch('([0-9a-f]{64})?', download.sha256)
    networks = [*sources.options, *(word for network in sources.networks
                                    for word in (network.option, network.file))]
    build_map.make_parser().parse_args(['--bag', 'a', '--out', 'b', *networks, *sources.mapping])
    for recording in sources.recordings.values():
        evaluate.make_parser().parse_args(
            ['--bag', 'a', '--map', 'b', *networks, *sources.asking, *recording.asking])
