# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reproduce the paper: ``python -m studies.reproduce fr3``, or ``script/reproduce fr3``.

The program lists its downloads with their licences and asks for confirmation. Then it downloads
public sequences and the paper's networks, builds a map from every second frame, localizes some of
the other frames, and prints the paper's Table 1 beside the results. Each stage writes its files
when it is complete, so the same command continues after an interruption. results.tar is small
enough to attach to an issue. Addresses, digests and the paper's numbers are in
studies/reproduce.yaml.
"""

import argparse
import csv
import fcntl
import hashlib
import json
import os
import platform
import shutil
import sys
import tarfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cliploc_ros.cli import build_map, evaluate
from cliploc_ros.command import positive_int, run_main
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import DatasetError, MappingError, OptionsError
from cliploc_ros.files.storage import make_folder, write_file, write_text
from cliploc_ros.models.files import download
from cliploc_ros.offline import page as html
from cliploc_ros.offline.datasets.folders import find_layout, read_sequence
from cliploc_ros.offline.datasets.tum import ConversionOptions, convert_tum
from cliploc_ros.offline.evaluation import summary
from cliploc_ros.offline.evaluation.run import CAPTIONS, COMPARISON
from cliploc_ros.offline.evaluation.trials import Result

#: Addresses and digests of the downloads.
SOURCES = Path(__file__).with_suffix('.yaml')
_NAMES = 'fr2', 'fr3', 'kitchen'
# Bandwidth of a typical connection, to estimate the time of a download.
_MEGABYTES_A_S = 10.0
# Largest ratio of the size of an unpacked sequence to Recording.unpacked, which is an estimate
# (chosen), and least space of an unpacked file [bytes].
_MOST_GROWTH = 2.0
_BLOCK_BYTES = 4096
# Names of a sequence's bags: for the map, and for the queries.
_MAPPED, _ASKED = 'mapped', 'asked'
_FIGURES = 'success_over_threshold', 'success_over_iterations', 'top_view'
# Columns of the table of `evaluate`: all but accepted and precision. The paper's columns follow.
_COLUMNS = (0, 1, 2, 3, 4, 7)
_OF_PAPER = ('paper: success', 'paper: error [m]', 'paper: time [s]')
_CSV_OF_PAPER = [f'paper_{name}{kind}' for name in ('success', 'error_m', 'time_s')
                 for kind in ('', '_std')]
_AGAIN = 'run the same command again to continue from here'


@dataclass(frozen=True)
class Download:
    """A file to download."""

    name: str
    url: str
    megabytes: float
    licence: str
    sha256: str = ''  #: '' if unknown: the digest of the first download is used
    option: str = ''  #: For a network: the option of build_map and evaluate that selects it

    @property
    def file(self) -> str:
        """Return the file's name."""
        return self.url.rpartition('/')[2]


@dataclass(frozen=True, kw_only=True)
class Recording(Download):
    """An archive with a sequence, and settings for processing it."""

    unpacked: float  #: Disk space needed in addition to the archive [MB]
    queries: int
    inner: str = ''  #: Nested archive that contains the sequence; '' for none
    minutes: Sequence[float] = (10, 60)  #: Processing time with a GPU, and without [min]
    asking: Sequence[str] = ()  #: Options of evaluate
    #: Success, error and time of the paper's methods, as printed in the paper
    paper: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Sources:
    """The content of reproduce.yaml."""

    networks: Sequence[Download]
    recordings: Mapping[str, Recording]
    options: Sequence[str]
    mapping: Sequence[str]
    asking: Sequence[str]
    remarks: Sequence[str]

    @classmethod
    def of_file(cls, path: Path) -> 'Sources':
        """Read a file; CliplocError: it cannot be read, or an entry is missing."""
        content = read_parameter_file(path)
        try:
            recordings = {key: Recording(**entry)
                          for key, entry in content.pop('sequences').items()}
            networks = [Download(**entry) for entry in content.pop('networks')]
            return cls(networks, recordings, **content)
        except (KeyError, TypeError, AttributeError) as error:
            raise OptionsError(f'{path} is not like {SOURCES.name}: {error}') from error

    def recording(self, name: str) -> Recording:
        """Return a sequence; OptionsError: there is none of this name."""
        if name not in self.recordings:
            raise OptionsError(f'--sources has no sequence {name}: see studies/reproduce.yaml')
        return self.recordings[name]


def main(args: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    return run_main(make_parser(), run, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog='script/reproduce', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('sequence', choices=[*_NAMES, 'all'])
    parser.add_argument('--yes', action='store_true', help='do not ask for confirmation')
    parser.add_argument('--plan', action='store_true', help='print the plan, then exit')
    # The script asks before it installs PyTorch.
    parser.add_argument('--ask', action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--out', type=Path, default=Path('reproduction'), metavar='DIR',
                        help='folder for downloads and results (%(default)s)')
    parser.add_argument('--trials', type=positive_int, default=5, metavar='N',
                        help="seeds of the methods that draw samples (the paper's %(default)s)")
    parser.add_argument('--sources', type=Path, default=SOURCES, metavar='YAML',
                        help='file with addresses and digests (studies/reproduce.yaml)')
    return parser


def run(options: argparse.Namespace) -> int:
    """Reproduce with the given options; return the exit code."""
    sources, out = Sources.of_file(options.sources), options.out
    names = _NAMES if options.sequence == 'all' else (options.sequence,)
    for name in names:
        sources.recording(name)
    if not options.plan:
        make_folder(out)
    _say_plan(names, sources, out)
    if options.plan:
        return 0
    if not options.yes and not is_agreed():
        return 1
    if options.ask:
        return 0
    with alone_in(out):
        networks = list(sources.options)
        for network in sources.networks:
            networks += [network.option, str(_downloaded(network, out))]
        for name in names:
            _reproduce(name, sources, networks, options)
        _write_results(names, sources, out)
    return 0


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Lock a folder against other runs; OptionsError: another run has locked it."""
    with (out / '.lock').open('w') as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OptionsError(f'{out}: another run is at work there: wait for it, or choose '
                               'another --out') from None
        yield


def _missing(names: Sequence[str], sources: Sources, out: Path) -> list[Download]:
    """Return the downloads that are still missing."""
    needed = [*(sources.recordings[name] for name in names if not (
        (out / name / 'frames').exists() or _has_bags(out / name))), *sources.networks]
    return [download for download in needed if not (out / 'downloads' / download.file).exists()]


def _say_plan(names: Sequence[str], sources: Sources, out: Path) -> None:
    """Print the plan; OptionsError: the disk does not have enough space."""
    print('\n'.join(f'{name}: {sources.recordings[name].name}' for name in names))
    if find_spec('torch') is None:
        print('script/setup models will first install PyTorch: up to 7 GB.')
    slow, fast = (sum(sources.recordings[name].minutes[column] for name in names)
                  for column in (1, 0))
    print(f'The computation takes about {slow} minutes on two cores, {fast} with a GPU (a guess).')
    print('Differences from the paper:', *(f'\n  {line}' for line in sources.remarks))
    say_downloads(_missing(names, sources, out), out)


def say_downloads(missing: Sequence[Download], out: Path) -> None:
    """List files to download and the room they need; OptionsError: the disk lacks it."""
    total = sum(download.megabytes for download in missing)
    room = total + sum(download.unpacked for download in missing
                       if isinstance(download, Recording))
    if missing:
        print(summary.as_text([('to download', 'MB', 'licence', 'from'), *(
            (download.name, f'{download.megabytes:.0f}', download.licence, download.url)
            for download in missing)]))
        print('Their licences apply to you and to the results. By continuing you accept them.')
    print(f'{total:.0f} MB to download, {total / _MEGABYTES_A_S / 60:.0f} minutes at '
          f'{_MEGABYTES_A_S:g} MB/s. {out} will need {room / 1e3:.1f} GB more.', flush=True)
    there = next(each for each in (out.absolute(), *out.absolute().parents) if each.exists())
    if (free := shutil.disk_usage(there).free / 1e6) < room:
        raise OptionsError(f'the disk of {out} has {free / 1e3:.1f} GB left, {room / 1e3:.1f} GB '
                           'are needed: make room, or set --out to another disk')


def is_agreed() -> bool:
    """Ask whether to download; OptionsError: nobody can answer."""
    try:
        agreed = input('Continue? [y/N] ').strip().lower() in ('y', 'yes')
    except EOFError:
        raise OptionsError('standard input is closed, so nobody can confirm: give --yes') from None
    if not agreed:
        print('nothing was downloaded')
    return agreed


def _download_file(url: str, file: Path, remedy: str, setting: str) -> Path:
    """Download a file from its address, or continue an interrupted download.

    A partial file has the name NAME.partial. ModelError, remedy and setting: see `download`.
    """
    partial = file.with_name(f'{file.name}.partial')

    def fetch() -> Path:
        os.environ.setdefault('HF_HUB_DISABLE_TELEMETRY', '1')
        from huggingface_hub.errors import HfHubHTTPError
        from huggingface_hub.file_download import http_get

        try:
            with partial.open('ab') as opened:
                http_get(url, opened, resume_size=opened.tell(), displayed_filename=file.name)
        except HfHubHTTPError as error:
            if error.response.status_code == 416:  # the partial file is longer than the file
                partial.unlink()
            raise
        return partial.replace(file)

    return download(url, file.parent, remedy, fetch, setting)


def _downloaded(wanted: Download, out: Path) -> Path:
    """Download a file and check its digest; CliplocError: one of the two fails."""
    file = out / 'downloads' / wanted.file
    if not file.exists():
        print(f'downloading {wanted.name}', flush=True)
        _download_file(wanted.url, file, f'Check network and address, then {_AGAIN}; or put the '
                       f'file there yourself, as {file}', '--out')
    with file.open('rb') as opened:
        digest = hashlib.file_digest(opened, 'sha256').hexdigest()
    kept = _digest_file(file)
    expected = wanted.sha256 or (kept.read_text().strip() if kept.exists() else digest)
    if digest != expected:
        refused = file.replace(file.with_name(f'{file.name}.refused'))
        raise DatasetError(
            f'{file} has SHA-256 {digest}, expected {expected}: it is damaged, or another file is '
            f'at {wanted.url}. It is kept as {refused.name}. Run again to download it again; if '
            'the file is correct, give --sources a copy of studies/reproduce.yaml with its digest')
    write_text(kept, digest + '\n')
    return file


def _digest_file(file: Path) -> Path:
    return file.with_name(f'{file.name}.sha256')


def _reproduce(name: str, sources: Sources, networks: Sequence[str],
               options: argparse.Namespace) -> None:
    """Process a sequence from its archive to the results of `evaluate`."""
    recording, folder = sources.recordings[name], options.out / name
    make_folder(folder)
    settings = repr((recording, sources.options, sources.mapping, sources.asking, options.trials))
    begun = folder / 'settings.txt'
    if begun.exists() and begun.read_text() != settings:
        raise OptionsError(f'{folder} was begun with other --sources or --trials: give the same, '
                           'another --out, or remove it')
    write_text(begun, settings)
    if not _has_bags(folder):
        write_bags(recording, unpacked(recording, folder, options.out), folder)
    landmark_map, evaluation = folder / 'map.yaml', folder / 'evaluation'
    if not landmark_map.exists():
        print(f'{name}: the map', flush=True)
        if build_map.build(build_map.make_parser().parse_args([
                '--bag', str(folder / _MAPPED), '--out', str(landmark_map), '--no-check',
                '--no-keyframe-layer', *networks, *sources.mapping])):
            raise MappingError(f'{name}: no map was built, see above: attach that text to an '
                               'issue')
    if not (evaluation / COMPARISON).exists():
        print(f'{name}: the queries', flush=True)
        evaluate.evaluate(evaluate.make_parser().parse_args([
            '--bag', str(folder / _ASKED), '--map', str(landmark_map), '--out', str(evaluation),
            '--trials', str(options.trials), *networks, *sources.asking, *recording.asking]))


def _has_bags(folder: Path) -> bool:
    return (folder / _MAPPED).exists() and (folder / _ASKED).exists()


def unpacked(recording: Recording, folder: Path, out: Path) -> Path:
    """Unpack a sequence; CliplocError: its archive cannot be downloaded or unpacked."""
    frames, staging = folder / 'frames', folder / '.frames'
    archive = inner = out / 'downloads' / recording.file
    if not frames.exists():
        _downloaded(recording, out)
        print(f'unpacking {archive}', flush=True)
        shutil.rmtree(staging, ignore_errors=True)  # left by a killed run
        try:
            if recording.inner:
                _check_size(archive, recording, recording.inner)
                with zipfile.ZipFile(archive) as opened:
                    inner = Path(opened.extract(recording.inner, staging))
            _check_size(inner, recording)
            # zip archives accept no filter, and never write outside the folder
            shutil.unpack_archive(inner, staging,
                                  filter=None if inner.suffix == '.zip' else 'data')
            if not staging.exists():
                raise shutil.ReadError('none of its members can be unpacked here')
        except Exception as error:  # the libraries raise any exception for a damaged archive
            shutil.rmtree(staging, ignore_errors=True)
            if isinstance(error, OSError) and error.errno:
                raise DatasetError(f'{staging} cannot be written: {error.strerror}; make room, '
                                   f'then {_AGAIN}') from error
            for file in (archive, _digest_file(archive)):
                file.unlink(missing_ok=True)
            raise DatasetError(f'{archive} cannot be unpacked ({error}): it is truncated or a '
                               'different file, and was removed; run again to download it'
                               ) from error
        staging.rename(frames)
    for sequence in (frames, *sorted(path for path in frames.rglob('*') if path.is_dir())):
        if find_layout(sequence) is not None:
            return sequence
    raise DatasetError(f'{frames} has no sequence of a known layout: remove it and {archive}*, '
                       'and run again')


def _check_size(archive: Path, recording: Recording, name: str = '') -> None:
    """Raise shutil.ReadError if an archive, or one of its members, unpacks to far too many bytes.

    A small file may unpack to any size.
    """
    most_mb = _MOST_GROWTH * recording.unpacked
    left = 1e6 * most_mb
    with (zipfile.ZipFile if archive.suffix == '.zip' else tarfile.open)(archive) as opened:
        for member in ([opened.getinfo(name)] if name else opened.infolist()) if isinstance(
                opened, zipfile.ZipFile) else opened:
            left -= _BLOCK_BYTES + (member.file_size if isinstance(member, zipfile.ZipInfo)
                                    else member.size)
            if left < 0.0:
                raise shutil.ReadError(f'it unpacks to more than {most_mb:g} MB')


def write_bags(recording: Recording, frames: Path, folder: Path) -> None:
    """Write every second frame with a true pose, and some of the others, as tum_to_bag does."""
    sequence, camera, _ = read_sequence(frames, None)
    rows = [row for row, stamp_ns in enumerate(sequence.stamps_ns)
            if sequence.pose_at(stamp_ns) is not None]
    others = rows[1::2]
    count = min(recording.queries, len(others))
    chosen = np.linspace(0, len(others) - 1, count).round().astype(int)
    for name, chosen_rows in ((_MAPPED, rows[::2]), (_ASKED, [others[place] for place in chosen])):
        if not (folder / name).exists():
            convert_tum(
                replace(sequence, stamps_ns=tuple(sequence.stamps_ns[row] for row in chosen_rows),
                        image_paths=tuple(sequence.image_paths[row] for row in chosen_rows)),
                camera, folder / name, ConversionOptions(image_format='compressed'))


def _table(folder: Path, paper: Mapping[str, Sequence[str]]) -> list[tuple[str, ...]]:
    """Return the table of `evaluate`, header first, with the paper's numbers beside it."""
    results = json.loads((folder / 'results.json').read_text())
    summaries = summary.summarize(Result(**result) for result in results)
    rows = [tuple(row[column] for column in _COLUMNS) for row in summary.table_rows(summaries)]
    if not paper:
        return rows
    beside = [_OF_PAPER, *(tuple(paper.get(method.method, ('', '', ''))) for method in summaries)]
    return [row + cells for row, cells in zip(rows, beside, strict=True)]


def _csv_rows(name: str, folder: Path, paper: Mapping[str, Sequence[str]]
              ) -> Iterator[dict[str, str]]:
    """Yield the rows of summary.csv of `evaluate`, with the paper's numbers."""
    with (folder / 'summary.csv').open(newline='') as file:
        for row in csv.DictReader(file):
            beside = paper.get(row['method'], ('', '', ''))
            numbers = [part for cell in beside for part in cell.partition('±')[::2]]
            yield {'sequence': name, **row, **dict(zip(_CSV_OF_PAPER, numbers, strict=True))}


def _write_results(names: Sequence[str], sources: Sources, out: Path) -> None:
    """Print the tables, write them as text, CSV, LaTeX and a page, and pack all in results.tar."""
    texts: list[str] = []
    lines: list[dict[str, str]] = []
    latex, parts = [], []
    for name in names:
        recording, folder = sources.recordings[name], out / name / 'evaluation'
        rows, title = _table(folder, recording.paper), f'{name}: {recording.name}'
        texts += [title, summary.as_text(rows), '']
        lines += (own := [*_csv_rows(name, folder, recording.paper)])
        latex.append(f'% {title}\n{summary.as_latex(own)}')
        parts.append(html.fold(title, html.table(rows[0], rows[1:]), html.side_by_side(
            html.figure((folder / f'{figure}.png').read_bytes(), CAPTIONS[figure], figure)
            for figure in _FIGURES), is_open=True))
    notes = ['± is the standard deviation over trials; for the time, over searches.',
             '~: there are too few queries to distinguish it from the method with the most '
             'success within 1 m.', *sources.remarks]
    texts += notes
    print('\n'.join(['', *texts, '']), flush=True)
    write_text(out / 'table.txt', '\n'.join([*texts, '']))
    write_text(out / 'table.csv', summary.csv_text(lines))
    write_text(out / 'table.tex', '\n'.join(latex))
    write_text(out / 'page.html', html.page("The paper's table, on this machine", *parts,
                                            html.items(notes)))
    write_text(out / 'about.json', json.dumps(_about(out, names, sources), indent=1))
    files = ['table.txt', 'table.csv', 'table.tex', 'page.html', 'about.json', *(
        f'{name}/{file}' for name in names for file in (
            'map.yaml', 'evaluation/results.json', 'evaluation/summary.csv'))]

    def pack(path: Path) -> None:
        with tarfile.open(path, 'w') as archive:
            for file in files:
                archive.add(out / file, f'reproduction/{file}')

    write_file(out / 'results.tar', pack)
    size = (out / 'results.tar').stat().st_size / 1e6
    print(f'look at {out / "page.html"}; attach {out / "results.tar"} ({size:.1f} MB) to an issue')


def _about(out: Path, names: Sequence[str], sources: Sources) -> dict[str, Any]:
    """Describe the origin of the results: machine, versions, files."""
    versions = {}
    for package in ('cliploc_ros', 'numpy', 'torch', 'open_clip_torch', 'openvino',
                    'ultralytics-opencv-headless'):
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return {'machine': platform.platform(), 'cores': os.cpu_count(), 'python': sys.version,
            'packages': versions, 'networks': [asdict(network) for network in sources.networks],
            'sequences': {name: asdict(sources.recordings[name]) for name in names},
            'digests': {file.stem: file.read_text().strip()
                        for file in sorted((out / 'downloads').glob('*.sha256'))}}


if __name__ == '__main__':
    sys.exit(main())
