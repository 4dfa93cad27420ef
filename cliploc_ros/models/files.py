# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of weights: checks, fingerprints, downloads, networks of the hub; folders of a cache."""

import errno
import hashlib
import json
import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from cliploc_ros.errors import ModelError, first_line
from cliploc_ros.files import storage

_BLOCK_BYTES = 64 * 1024
_BLOCK_COUNT = 66
# A zip archive, a bare pickle (PyTorch before 1.6), a NumPy array.
_HEADS = (b'PK', b'\x80', b'\x93NUMPY')
# OWNER/NAME[@REVISION][:FILE]; the revision is a branch, tag, commit or refs/pr/NUMBER.
_NAME = re.compile(r'([\w-][\w.-]*/[\w-][\w.-]*)(?:@(\w[\w.-]*(?:/\w[\w.-]*)*))?'
                   r'(?::(\w[\w./-]*\.onnx))?')
# Suffixes of local files, which are no names on the hub.
_LOCAL = ('.onnx', '.pt', '.pth', '.ts', '.safetensors', '.bin', '.json')
# The digests of the hub: SHA-256 for large files, otherwise git's SHA-1.
_DIGEST = re.compile('[0-9a-f]{40}|[0-9a-f]{64}')
# A file of weights as named in an ONNX file: the key of an entry, and the size of the name.
_LOCATION, _MOST_NAME = re.compile(rb'\n\x08location\x12([\x80-\xff]?[\0-\x7f])'), 4096
# Size of a file whose digest is kept [bytes], the greatest number of these, and the least age of
# a change [ns]: a file system may give two changes at once the same time.
_LARGE, _MOST_DIGESTS, _SETTLED_NS = 2**24, 32, 3 * 10**9
# Time-out of the first request, in case a firewall drops its packets [s].
_PATIENCE_S = 10.0

logger = logging.getLogger(__name__)


def fingerprint_file(path: Path) -> str:
    """Return a hash that distinguishes files of weights; it takes milliseconds.

    It is the SHA-256 of the size and of 66 evenly spaced blocks of 64 KiB, including head and
    tail. Training changes all tensors, and thus the blocks. The hash misses an edit of a few bytes
    between the blocks. ModelError: the file cannot be read.
    """
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        last = max(size - _BLOCK_BYTES, 0)
        digest = hashlib.sha256(str(size).encode())
        for offset in sorted({last * index // (_BLOCK_COUNT - 1)
                              for index in range(_BLOCK_COUNT)}):
            file.seek(offset)
            digest.update(file.read(_BLOCK_BYTES))
    return digest.hexdigest()


def digest_file(path: Path, cache_dir: str | None = None) -> str:
    """Return the SHA-256 of a file, see _content; ModelError: the file cannot be read."""
    return _content(path, cache_dir)[0]


def digest_network(file: Path, cache_dir: str | None = None) -> str:
    """Return the digests of an ONNX file and of all files of weights that it names."""
    return ':'.join(digest_file(path, cache_dir) if path.is_file() else ''
                    for path in (file, *weights_beside(file, cache_dir)))


def weights_beside(file: Path, cache_dir: str | None = None) -> list[Path]:
    """Return the files of weights that an ONNX file names; ModelError: it cannot be read."""
    return [file.parent / name for name in _content(file, cache_dir)[1]]


def _content(path: Path, cache_dir: str | None) -> tuple[str, list[str]]:
    """Return the SHA-256 of a file, and the names of the files of weights in an ONNX file.

    With a cache_dir, those of a large file are kept there until the file is written, moved or
    copied: each of these changes the time of its last change (ctime), which programs cannot set. A
    fault of the disk does not, but OpenVINO then runs the compiled network, with a digest of its
    own, and the file is read in full before it is compiled.
    """
    with _opened(path) as file:
        status = os.fstat(file.fileno())
    state = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    if cache_dir is None or status.st_size < _LARGE:
        return _read(path, *state)
    name = hashlib.sha256(json.dumps([str(path.absolute()), *state]).encode()).hexdigest()
    kept = storage.resolve_cache_dir(cache_dir) / 'digests' / f'{path.stem}-{name[:32]}.json'
    with suppress(OSError, ValueError):
        storage.check_owners(kept.parent)
        check, _, text = storage.read_file(kept).decode().partition(' ')
        if hashlib.sha256(text.encode()).hexdigest() == check:
            digest, names = storage.parse_json(text)
            return digest, names
    found = _read(path, *state)
    text = json.dumps(found)
    with suppress(OSError):  # a read-only cache works too
        if time.time_ns() - status.st_ctime_ns > _SETTLED_NS:
            with new_entry(kept, _MOST_DIGESTS) as partial:
                partial.write_text(f'{hashlib.sha256(text.encode()).hexdigest()} {text}')
    return found


@lru_cache(64)
def _read(path: Path, *_unchanged: int) -> tuple[str, list[str]]:
    digest, names, end = hashlib.sha256(), set[str](), b''
    with _opened(path) as file:
        while block := file.read(2**20):
            digest.update(block)
            for text in (end + block[:_MOST_NAME], block) if path.suffix == '.onnx' else ():
                for match in _LOCATION.finditer(text) if b'\n\x08location' in text else ():
                    size = sum((byte & 127) << 7 * place for place, byte in enumerate(match[1]))
                    if len(name := text[match.end():match.end() + size]) == size:
                        names.add(os.fsdecode(name))
            end = block[-_MOST_NAME:]
    return digest.hexdigest(), sorted(names)


def _blob(path: Path) -> str:
    """Return the digest in the name of a file in the hub's cache, which is a link to it; or ''."""
    blob = path.readlink() if path.is_symlink() else path
    return blob.name if blob.parent.name == 'blobs' and _DIGEST.fullmatch(blob.name) else ''


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with storage.open_file(path) as file:
            yield file
    except OSError as error:
        raise ModelError(f'{path} cannot be read: {error.strerror}; check the path of the weights'
                         ) from error


def check_weights_file(path: Path) -> None:
    """Raise a ModelError for a file that is missing, unreadable, or no weights by its head.

    The loader checks the content.
    """
    with _opened(path) as file:
        head = file.read(512)
    if head.startswith(b'version https://git-lfs'):
        raise ModelError(f"{path} is a pointer of git-lfs, not the weights: run 'git lfs pull'")
    if path.suffix not in ('.onnx', '.safetensors') and not head.startswith(_HEADS):
        raise ModelError(f'{path} holds no weights: it is empty or not a file of PyTorch, and its '
                         'name is not that of an ONNX or safetensors file')


def download(what: str, folder: Path, remedy: str, fetch: Callable[[], str | Path],
             setting: str = '') -> Path:
    """Download a file with a function of a library; ModelError: that fails.

    ``fetch`` returns the path of the file, and must not leave a partial file there. The folder is
    made if it does not exist. The error names the file (``what``), and a ``remedy`` without a
    network. ``setting`` is the option that sets the folder; '': it is in the cache folder.
    """
    logger.info('downloading %s into %s', what, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = Path(fetch())
        _check_content(file, _blob(file), None)
        return file
    except ModelError:
        raise
    except Exception as error:  # each library has different exceptions
        reason = f'{type(error).__name__}: {first_line(error).rstrip(".")}'
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason = f'the disk of {folder} is full: make room{setting and f", or set {setting}"}'
        if not setting:
            remedy += ('; or run doctor --prepare --cache-dir DIR there, and copy the content of '
                       f'DIR into {folder.parent}')
        raise ModelError(f'cannot download {what}: {reason}. {remedy}') from error


@contextmanager
def new_entry(file: Path, most: int) -> Iterator[Path]:
    """Yield the path of a temporary file that becomes an entry of a cache, see replace_file.

    The folder is made if it does not exist. Beyond ``most`` entries, the least recently used ones
    are removed. Raises OSError if the folder belongs to another user, is read-only or full.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    storage.check_owners(file.parent)
    remove_unused(file.parent, most - 1)
    with storage.replace_file(file) as partial:
        yield partial


def remove_unused(folder: Path, most: int) -> None:
    """Remove the least recently used entries of a cache.

    Entries have a digest in their names. Other files stay: cache_dir may be a folder of the user
    with networks of his own.
    """
    def modified(entry: Path) -> float:
        try:
            return entry.stat().st_mtime
        except OSError:  # another process has removed it
            return -1.0

    ours = [entry for entry in folder.iterdir()
            if re.search('-[0-9a-f]{32}', entry.name) and not entry.name.startswith('.')]
    for entry in sorted(ours, key=modified, reverse=True)[most:]:
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def is_hub_name(name: str) -> bool:
    """Return whether a name is OWNER/NAME[@REVISION][:FILE], and not a local file or folder."""
    match = _NAME.fullmatch(name)
    return (match is not None and Path(match[1]).suffix not in _LOCAL
            and not Path(name).expanduser().exists())


def resolve_folder(name: str, networks: Sequence[Sequence[str]], beside: Sequence[str],
                   cache_dir: str, option: str = 'model') -> Path:
    """Return a folder with networks and the files next to them; download it if necessary.

    A complete download is marked, and no further request is sent. Each file is compared with the
    digest given by the hub, at the download and at each use. A damaged file is downloaded again,
    and interrupted downloads are continued. Proxy, mirror and offline mode are those of
    huggingface_hub: HTTPS_PROXY, HF_ENDPOINT, HF_HUB_OFFLINE.

    ModelError: the name is neither a folder nor a name on the hub, or the download fails.

    Parameters
    ----------
    name : str
        A folder, or OWNER/NAME[@REVISION][:FILE].
    networks : sequence of sequences of str
        For each network, the patterns of its ONNX file. The first file that exists is used, with
        its file of weights. A FILE in the name replaces the patterns of the first network.
    beside : sequence of str
        Patterns of all other files. Those in folders belong to another layout than the first.
    option : str
        The option that takes the name.
    """
    folder = Path(name).expanduser().absolute()
    if folder.is_dir():
        return folder
    match = _NAME.fullmatch(name)
    if match is None:
        raise ModelError(f'{folder} does not exist: check the path of the network')
    repository, revision, file = match.groups()
    wanted = [[file], *networks[1:]] if file else list(networks)
    own = storage.resolve_cache_dir(cache_dir) / 'weights'
    request = json.dumps([repository, revision, [*map(list, wanted)], list(beside)])
    digest = hashlib.sha256(request.encode()).hexdigest()
    marker = own / f'{repository.replace("/", "--")}-{digest[:16]}.json'

    def choose(files: Sequence[str]) -> list[str]:
        chosen = [file for file in files if any(fnmatch(file, pattern) for pattern in beside)]
        for patterns in wanted:
            main = next((file for pattern in patterns for file in files
                         if fnmatch(file, pattern)), None)
            if main is None:
                raise ModelError(f'{name} has none of {", ".join(patterns)}: it has '
                                 f'{", ".join(files)}')
            chosen += [file for file in files if file.startswith(main)]
        return chosen

    try:
        place = Path(str(json.loads(storage.read_file(marker))))
        if place.is_absolute() or '..' in place.parts:
            raise ValueError('not a folder of this cache')
        found = own / place
        parts = [found / part for part in choose(
            [str(path.relative_to(found)) for path in found.rglob('*')])]
        for path in [*parts, *(path for part in parts
                               for path in weights_beside(part, cache_dir))]:
            _check_content(path, _blob(path), cache_dir)
        return found
    except (OSError, ValueError, RecursionError, ModelError) as error:
        if marker.exists():
            logger.warning('%s in %s cannot be used (%s): downloading it again', name, own, error)

    def fetch() -> Path:
        os.environ.setdefault('HF_HUB_DISABLE_TELEMETRY', '1')
        import huggingface_hub as hub

        info = hub.HfApi().model_info(repository, revision=revision, timeout=_PATIENCE_S)
        commit, files = info.sha, [sibling.rfilename for sibling in info.siblings or ()
                                   if '..' not in Path(sibling.rfilename).parts
                                   and not sibling.rfilename.startswith('/')]
        chosen = choose(files)
        for part in chosen:
            # before the download, which uses both as names of files
            stated = hub.get_hf_file_metadata(hub.hf_hub_url(
                repository, part, revision=commit), timeout=_PATIENCE_S)
            if not all(map(_DIGEST.fullmatch, (str(stated.etag), str(commit)))):
                raise ValueError(f'the hub states no digest of {part}, but {stated.etag!r:.80} '
                                 f'and the commit {commit!r:.80}')
            path = Path(hub.hf_hub_download(repository, part, revision=commit, cache_dir=own))
            _check_content(path, str(stated.etag), None)
            snapshot = Path(str(path)[:-len(part)])
            chosen += [file for file in files if file not in chosen
                       and snapshot / file in weights_beside(path)]
        with storage.replace_file(marker) as partial:
            partial.write_text(json.dumps(str(snapshot.resolve().relative_to(own.resolve()))))
        return snapshot

    listed = ', '.join([*(patterns[0] for patterns in wanted),
                        *(pattern for pattern in beside if '/' not in pattern)])
    return download(f"the network '{name}'", own, (
        f'Without a network: download {listed} from https://huggingface.co/{repository} on '
        f'another machine into a folder, and set `{option}` to its path'
        + ', or use no CLIP: `no_clip`, `matching: class`' * (option == 'clip_pretrained')), fetch)


def find_network(folder: Path, name: str, networks: Sequence[str]) -> Path:
    """Return the ONNX file in a folder of `resolve_folder`; ModelError: there is none."""
    match = _NAME.fullmatch(name)
    for pattern in [match[3]] if match is not None and match[3] else networks:
        for file in sorted(folder.glob(pattern)):
            return file
    raise ModelError(f'{folder} has none of {", ".join(networks)}: put an ONNX file there')


def _check_content(file: Path, stated: str, cache_dir: str | None) -> None:
    """Compare a file with its digest on the hub; ValueError: it differs, and was removed."""
    if not stated:
        return
    content = b'' if len(stated) == 64 else storage.read_file(file)
    if stated != (digest_file(file, cache_dir) if len(stated) == 64 else hashlib.sha1(
            b'blob %d\0' % len(content) + content, usedforsecurity=False).hexdigest()):
        file.resolve().unlink()
        raise ValueError(f'the digest of {file.name} differs from that on the hub')
