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
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import BinaryIO

from cliploc_ros.errors import ModelError
from cliploc_ros.files.storage import open_file, read_file, replace_file, resolve_cache_dir

_BLOCK_BYTES = 64 * 1024
_BLOCK_COUNT = 66
# A zip archive, a bare pickle (PyTorch before 1.6), a NumPy array.
_HEADS = (b'PK', b'\x80', b'\x93NUMPY')
# OWNER/NAME[@REVISION][:FILE]; the revision is a branch, tag or commit.
_NAME = re.compile(r'([\w-][\w.-]*/[\w-][\w.-]*)(?:@([\w][\w.-]*))?(?::([\w][\w./-]*\.onnx))?')
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


def _opened(path: Path) -> BinaryIO:
    try:
        return open_file(path)
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
             setting: str = 'cache_dir') -> Path:
    """Download a file with a function of a library; ModelError: that fails.

    ``fetch`` returns the path of the file, and must not leave a partial file there. The folder is
    made if it does not exist. The error names the file (``what``), and a ``remedy`` without a
    network. ``setting`` is the option that sets the folder.
    """
    logger.info('downloading %s into %s', what, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return Path(fetch())
    except ModelError:
        raise
    except Exception as error:  # each library has different exceptions
        reason = f'{type(error).__name__}: {first_line(error).rstrip(".")}'
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason = f'the disk of {folder} is full: make room, or set {setting} to another disk'
        if setting == 'cache_dir':
            remedy += ('; or run doctor --prepare --cache-dir there, and set cache_dir to a '
                       'copy of its folder')
        raise ModelError(f'cannot download {what}: {reason}. {remedy}') from error


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


def first_line(error: Exception) -> str:
    """Return the first line of an error in ASCII, without emojis and colours."""
    lines = str(error).encode('ascii', 'ignore').decode().strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__


def is_hub_name(name: str) -> bool:
    """Return whether a name is OWNER/NAME[@REVISION][:FILE], and not a local file or folder."""
    return (not Path(name).expanduser().exists() and _NAME.fullmatch(name) is not None
            and Path(name).suffix not in ('.pt', '.ts', '.safetensors', '.bin', '.json'))


def resolve_folder(name: str, networks: Sequence[Sequence[str]], beside: Sequence[str],
                   cache_dir: str) -> Path:
    """Return a folder with networks and the files next to them; download it if necessary.

    A complete download is marked, and no further request is sent. Each file is compared with the
    digest given by the hub, and interrupted downloads are continued. Proxy, mirror and offline
    mode are those of huggingface_hub: HTTPS_PROXY, HF_ENDPOINT, HF_HUB_OFFLINE.

    ModelError: the name is neither a folder nor a name on the hub, or the download fails.

    Parameters
    ----------
    name : str
        A folder, or OWNER/NAME[@REVISION][:FILE].
    networks : sequence of sequences of str
        For each network, the patterns of its ONNX file. The first file that exists is used, with
        its file of weights. A FILE in the name replaces the patterns of the first network.
    beside : sequence of str
        Patterns of all other files.
    """
    folder = Path(name).expanduser().absolute()
    if folder.is_dir():
        return folder
    match = _NAME.fullmatch(name)
    if match is None:
        raise ModelError(f'{folder} does not exist: check the path of the network')
    repository, revision, file = match.groups()
    wanted = [[file], *networks[1:]] if file else list(networks)
    own = resolve_cache_dir(cache_dir) / 'weights'
    request = json.dumps([repository, revision, [*map(list, wanted)], list(beside)])
    digest = hashlib.sha256(request.encode()).hexdigest()
    marker = own / f'{repository.replace("/", "--")}-{digest[:16]}.json'
    try:
        found = own / str(json.loads(read_file(marker)))
    except (OSError, ValueError):
        found = own / 'missing'
    if found.is_dir():
        return found

    def fetch() -> Path:
        os.environ.setdefault('HF_HUB_DISABLE_TELEMETRY', '1')
        import huggingface_hub

        info = huggingface_hub.HfApi().model_info(repository, revision=revision,
                                                  timeout=_PATIENCE_S)
        files = [sibling.rfilename for sibling in info.siblings or ()]
        chosen = [file for file in files if any(fnmatch(file, pattern) for pattern in beside)]
        for patterns in wanted:
            main = next((file for pattern in patterns for file in files
                         if fnmatch(file, pattern)), None)
            if main is None:
                raise ModelError(f'{name} has none of {", ".join(patterns)}: it has '
                                 f'{", ".join(files)}')
            chosen += [file for file in files if file.startswith(main)]
        for file in chosen:
            path = Path(huggingface_hub.hf_hub_download(
                repository, file, revision=info.sha, cache_dir=own))
            _check_content(path)
        snapshot = Path(str(path)[:-len(file)])
        with replace_file(marker) as partial:
            partial.write_text(json.dumps(str(snapshot.relative_to(own))))
        return snapshot

    listed = ', '.join([*(patterns[0] for patterns in wanted), *beside])
    return download(f"the network '{name}'", own, (
        f'Without a network: download {listed} from https://huggingface.co/{repository} on '
        'another machine into a folder, and give the path of that folder'), fetch)


def find_network(folder: Path, name: str, networks: Sequence[str]) -> Path:
    """Return the ONNX file in a folder of `resolve_folder`; ModelError: there is none."""
    match = _NAME.fullmatch(name)
    if match is not None and match[3] and (folder / match[3]).is_file():
        return folder / match[3]
    for pattern in networks:
        for file in sorted(folder.glob(pattern)):
            return file
    raise ModelError(f'{folder} has none of {", ".join(networks)}: put an ONNX file there')


def _check_content(file: Path) -> None:
    """Compare a file with its digest on the hub; ValueError: it differs, and was removed.

    The hub's cache names each file after its digest: SHA-256 for large files, otherwise git's
    SHA-1.
    """
    blob = file.resolve()
    content = hashlib.sha256 if len(blob.name) == 64 else hashlib.sha1
    head = b'' if len(blob.name) == 64 else b'blob %d\0' % blob.stat().st_size
    digest = content(head, usedforsecurity=False)
    with blob.open('rb') as opened:
        while block := opened.read(2**20):
            digest.update(block)
    if len(blob.name) in (40, 64) and digest.hexdigest() != blob.name:
        blob.unlink()
        raise ValueError(f'the digest of {file.name} differs from that on the hub')
