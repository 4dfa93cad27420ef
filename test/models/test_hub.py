# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Downloads from a local model hub: made once, complete, and used offline.

They run in separate processes: the libraries read addresses and proxies once, on import.
"""

import hashlib
import http.server
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import onnx
import pytest
from disks import small_disk

from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
from demo import ASSETS

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
COMMIT = '1' * 40
RESOLVE = """
import contextlib, json, sys
from cliploc_ros.errors import ModelError
from cliploc_ros.models.protocols import ClipOptions
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.files import find_network, resolve_folder
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
cache, name = sys.argv[1:]
networks = ['model.onnx', 'onnx/model.onnx']
try:
    if name.startswith('yolo'):
        load_detector(DetectorOptions(name, cache_dir=cache))
    elif name.startswith('ViT'):
        with contextlib.suppress(ModelError):
            resolve_clip_weights(ClipOptions(name, 'openai', cache_dir=cache))
        resolve_clip_weights(ClipOptions(name, 'openai', cache_dir=cache))
    folder = resolve_folder(name, [networks], ['config.json', 'visual/c.json'], cache)
    print(json.dumps({'network': str(find_network(folder, name, networks))}))
except ModelError as error:
    print(json.dumps({'error': str(error)}))
"""


class Hub(http.server.BaseHTTPRequestHandler):
    """The parts of a model hub that a download needs."""

    files: dict[str, bytes]
    #: Content that is sent in place of a file
    sent: dict[str, bytes]
    requests: list[str]
    #: Sent in place of the SHA-256 of each file
    etag: str
    #: A file that is sent in part, and the size of this part
    broken: tuple[str, int] | None

    def do_HEAD(self):
        self._answer(False)

    def do_GET(self):
        self._answer(True)

    def _answer(self, has_body):
        self.requests.append(f'{self.command} {self.path}')
        if '/api/models/' in self.path:
            body, extra = json.dumps({
                'id': 'someone/net', 'sha': COMMIT,
                'siblings': [{'rfilename': name} for name in self.files]}).encode(), {}
        else:
            name = self.path.partition('/resolve/')[2].partition('/')[2]
            if name not in self.files:
                self.send_response(404)
                self.send_header('X-Error-Code', 'EntryNotFound')
                self.end_headers()
                return
            body = self.sent.get(name, self.files[name])
            etag = self.etag or hashlib.sha256(self.files[name]).hexdigest()
            extra = {'ETag': f'"{etag}"', 'X-Repo-Commit': COMMIT, 'Accept-Ranges': 'bytes'}
        start = int(self.headers.get('Range', 'bytes=0-')[6:].partition('-')[0])
        self.send_response(206 if start else 200)
        for key, value in extra.items():
            self.send_header(key, value)
        if start:
            self.send_header('Content-Range', f'bytes {start}-{len(body) - 1}/{len(body)}')
        self.send_header('Content-Length', str(len(body) - start))
        self.end_headers()
        if has_body:
            if self.broken and self.path.endswith(self.broken[0]):
                body = body[:self.broken[1]]
            self.wfile.write(body[start:])

    def log_message(self, *arguments):
        pass


@pytest.fixture
def hub(monkeypatch, tmp_path):
    Hub.files = {'config.json': b'{}', 'onnx/model.onnx': os.urandom(100_000),
                 'onnx/model.onnx_data': os.urandom(3_000_000),
                 'onnx/model_fp16.onnx': b'\x08half',
                 'model.safetensors': b'large', 'README.md': b'text'}
    Hub.sent, Hub.requests, Hub.broken, Hub.etag = {}, [], None, ''
    monkeypatch.setenv('HF_HOME', str(tmp_path / 'hub'))
    monkeypatch.setenv('HF_HUB_DISABLE_XET', '1')
    with http.server.ThreadingHTTPServer(('127.0.0.1', 0), Hub) as server:
        monkeypatch.setenv('HF_ENDPOINT', f'http://127.0.0.1:{server.server_port}')
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield Hub
        server.shutdown()


def resolve(cache: Path, name: str = 'someone/net', *within: str, **environment: str
            ) -> dict[str, str]:
    done = subprocess.run(
        [*within, sys.executable, '-c', RESOLVE, str(cache), name], cwd=PROJECT, text=True,
        env={**os.environ, 'NO_PROXY': '127.0.0.1', **environment}, capture_output=True,
        timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_download_is_made_once_and_of_what_is_needed(hub, tmp_path):
    found = Path(resolve(tmp_path / 'cache')['network'])
    assert found.read_bytes() == hub.files['onnx/model.onnx']
    names = {str(file.relative_to(found.parents[1])) for file in found.parents[1].rglob('*')}
    assert names == {'onnx', 'config.json', 'onnx/model.onnx', 'onnx/model.onnx_data'}
    assert tmp_path / 'cache/weights' in found.parents
    hub.requests.clear()
    assert Path(resolve(tmp_path / 'cache')['network']) == found
    assert hub.requests == [], 'a robot without a network does not wait for it'
    copied = tmp_path / 'cache'
    copied.rename(tmp_path / 'carried')
    assert 'carried' in resolve(tmp_path / 'carried', HF_HUB_OFFLINE='1')['network']


@pytest.mark.parametrize(('revision', 'asked'), [(COMMIT, COMMIT), ('refs/pr/1', 'refs%2Fpr%2F1')])
def test_a_revision_and_a_file(hub, tmp_path, revision, asked):
    found = Path(resolve(tmp_path, f'someone/net@{revision}:onnx/model_fp16.onnx')['network'])
    assert found.read_bytes() == b'\x08half'
    assert any(asked in request for request in hub.requests if '/api/' in request)


def test_weights_of_any_name_in_a_cache_behind_a_link(hub, tmp_path):
    """The cache has links to its files, which OpenVINO does not follow out of their folder."""
    onnx.save(onnx.load(ASSETS / 'yolo.onnx'), tmp_path / 'model.onnx', size_threshold=0,
              save_as_external_data=True, location='weights.bin')
    hub.files = {name: (tmp_path / name).read_bytes() for name in ('model.onnx', 'weights.bin')}
    (tmp_path / 'real').mkdir()
    (tmp_path / 'link').symlink_to('real')
    for _ in range(2):  # the second time from the cache
        network = resolve(tmp_path / 'link')['network']
        assert len(load_detector(DetectorOptions(network, cache_dir=str(tmp_path))).class_names)
        hub.files = {}


@pytest.mark.parametrize('etag', ['5' * 39, '../../../../evil', '1' * 63 + 'g', 'W'])
def test_a_hub_without_digests(hub, tmp_path, etag):
    hub.etag = etag
    assert 'the hub states no digest of config.json' in resolve(tmp_path / 'cache')['error']
    assert not any(path.is_file() for path in tmp_path.rglob('*'))


def test_a_hub_that_names_files_elsewhere(hub, tmp_path):
    hub.files |= {'onnx/model.onnx/../../../../../../evil': b'evil', '../../../config.json': b'e'}
    assert 'network' in resolve(tmp_path / 'a/b/cache')
    assert not [*tmp_path.rglob('evil')] and not any(path.read_bytes() == b'e'
                                                     for path in tmp_path.rglob('config.json'))


def test_damaged_files_of_the_cache_are_downloaded_again(hub, tmp_path):
    found = Path(resolve(tmp_path)['network'])
    for name in ('model.onnx', 'model.onnx_data', '../config.json'):
        file = found.parent / name
        file.write_bytes(file.read_bytes()[:-1] + b'x')
        assert 'network' in resolve(tmp_path)
        assert file.read_bytes() == hub.files[os.path.normpath(f'onnx/{name}')]
    marker, = (tmp_path / 'weights').glob('*.json')
    for place in (str(tmp_path), '../..', 'gone'):
        marker.write_text(json.dumps(place))
        assert Path(resolve(tmp_path)['network']) == found


def test_another_file_under_the_same_name(hub, tmp_path):
    hub.sent['onnx/model.onnx'] = os.urandom(100_000)
    text = resolve(tmp_path)['error']
    assert 'the digest of model.onnx differs from that on the hub' in text
    hub.sent.clear()
    assert 'network' in resolve(tmp_path)


def test_an_interrupted_download_goes_on(hub, tmp_path):
    hub.broken = ('onnx/model.onnx_data', 2_000_000)
    assert 'cannot download' in resolve(tmp_path)['error']
    hub.broken = None
    hub.requests.clear()
    found = Path(resolve(tmp_path)['network'])
    assert found.with_name('model.onnx_data').read_bytes() == hub.files['onnx/model.onnx_data']
    assert not any('GET' in line and line.endswith('/config.json') for line in hub.requests)


def test_weights_of_a_tag(hub, tmp_path):
    """They are downloaded once, even if they are then refused."""
    header = json.dumps({'visual.proj': {'dtype': 'F32', 'shape': [16],
                                         'data_offsets': [0, 64]}}).encode()
    hub.files = {'open_clip_model.safetensors': (
        len(header).to_bytes(8, 'little') + header + bytes(64))}
    text = resolve(tmp_path / 'cache', 'ViT-B-32')['error']  # asks twice
    assert "does not hold the weights of CLIP model 'ViT-B-32'" in text
    assert str(tmp_path / 'cache/weights') in text
    gets = [line for line in hub.requests if line.startswith('GET') and '/resolve/' in line]
    assert len(gets) == 1 and gets[0].endswith('open_clip_model.safetensors')


def test_networks_that_do_not_fit_on_the_disk(hub, tmp_path):
    disk = tmp_path / 'disk'
    disk.mkdir()
    text = resolve(disk, 'someone/net', *small_disk(disk))['error']
    assert f'{disk}/weights is full' in text and 'on another machine' in text


def test_without_a_network_the_message_names_files_and_remedy(tmp_path):
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        port = free.getsockname()[1]
    for environment in ({'HF_ENDPOINT': f'http://127.0.0.1:{port}'}, {'HF_HUB_OFFLINE': '1'}):
        text = resolve(tmp_path, **environment)['error']
        assert "cannot download the network 'someone/net'" in text
        assert 'model.onnx, config.json from https://huggingface.co/someone/net' in text
        assert 'set `model` to its path' in text and text.endswith(f'into {tmp_path}'), text
    text = resolve(tmp_path, 'not/a/name')['error']
    assert 'does not exist' in text
    text = resolve(tmp_path, 'yolov8n', HTTPS_PROXY=f'http://127.0.0.1:{port}')['error']
    assert 'yolov8n.pt' in text and 'on another machine' in text
    assert not any(file.name.startswith('yolo') for file in (tmp_path / 'weights').iterdir())
