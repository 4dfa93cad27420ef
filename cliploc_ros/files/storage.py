# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read files of any origin, find folders for files, and replace files safely."""

import atexit
import errno
import fcntl
import glob
import json
import logging
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from cliploc_ros.errors import OptionsError

logger = logging.getLogger(__name__)

#: The largest file that is read into memory as a whole [bytes].
MOST_BYTES = 256 * 2**20
# Values of a JSON text, each of which takes up to 64 bytes of memory, and digits of its integers:
# 64 bits have 19 or 20.
_MOST_VALUES = 8_000_000
_MOST_DIGITS = 20
# Writers of one folder wait this long for their turn, and look this often [s]: a set takes less.
_TURN_S, _TURN_POLL_S = 30.0, 0.02
# A full disk may still take an empty file.
_PROBE_BYTES = 4096
#: Advice about a file that cannot be written
MAKE_ROOM = 'make room, or choose another folder'
#: Files that this process could not keep in a cache, see warn_not_kept
NOT_KEPT: list[str] = []


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file to read it, whatever else a path of any origin names.

    OSError: there is none. A pipe would wait for a writer, a device would never end.
    """
    try:
        mode = Path(path).stat().st_mode  # first: a device may act as soon as it is opened
        if stat.S_ISREG(mode):
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), 'rb')
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_ISREG(mode):
                return file
            file.close()
    except ValueError as error:  # a zero byte, or no UTF-8
        raise OSError(errno.EINVAL, f'names no file: {error}') from error
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, 'a folder, not a regular file')
    raise OSError(errno.EINVAL, 'not a regular file')


def read_file(path: str | os.PathLike[str], most_bytes: int = MOST_BYTES) -> bytes:
    """Return the content of a regular file; OSError: there is none, or it is too large."""
    with open_file(path) as file:
        # a sparse file has any size
        size = os.fstat(file.fileno()).st_size
        content = file.read(most_bytes + 1) if size <= most_bytes else b''
    if max(size, len(content)) > most_bytes:
        raise OSError(errno.EFBIG, f'larger than {most_bytes // 2**20} MiB')
    return content


def parse_json(text: str | bytes, **options: Any) -> Any:
    """Return the value of a JSON text, see json.loads.

    ValueError: it is not JSON, or nested so deeply, so long, or with such numbers that no file of
    this package or of the programs that it reads is.
    """
    marks = (b',', b'[', b'{') if isinstance(text, bytes) else (',', '[', '{')
    if sum(map(text.count, marks)) > _MOST_VALUES:  # type: ignore[arg-type]
        raise ValueError(f'holds more than {_MOST_VALUES} values')
    try:
        return json.loads(text, parse_int=_integer, **options)
    except RecursionError as error:
        raise ValueError('is nested too deeply') from error


def _integer(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f'holds an integer of {len(digits)} digits')
    return int(digits)


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that becomes ``path`` when the block ends.

    The temporary file lies in the same folder and has the same suffix. It is flushed to disk
    before it replaces the old file, so that not even a power cut leaves half a file. An exception
    removes it, and the old file stays. A symbolic link is followed and stays, and an existing
    file keeps its mode.

    OSError: the folder is missing, read-only or full.
    """
    path = Path(os.path.realpath(path))
    # two containers that share the folder may have processes of the same number
    partial = path.with_name(f'.{secrets.token_hex(6)}.{path.name}')
    try:
        yield partial
        with partial.open('rb+') as file:
            os.fsync(file.fileno())
        _take_place(partial, path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _take_place(partial: Path, path: Path) -> None:
    """Let a file replace another one, whose mode it takes; a symbolic link is followed."""
    path = Path(os.path.realpath(path))
    with suppress(OSError):  # there is no file yet, or the file system has no modes
        partial.chmod(stat.S_IMODE(path.stat().st_mode))
    partial.replace(path)


#: Writes a file to a path, with the digest of its set in it.
WriteOfSet = Callable[[Path, str], object]


def replace_set(path: Path, digest: str, write: WriteOfSet,
                besides: Mapping[Path, WriteOfSet | None]) -> None:
    """Write a file and those beside it as one: whenever the process ends, a whole set is there.

    Those beside are written under other names first. The file itself takes its place in one step,
    and from then on its set is the new one: finish_set does what a kill leaves. Files that are not
    of its set have another digest. Two writers of one folder do this one after the other.

    Parameters
    ----------
    besides : mapping
        The other files in the same folder; None removes one.

    OSError, and what the callables raise: nothing was changed. OptionsError: the set was written,
    and a file that is not of it cannot be removed.
    """
    staged = {other: _staged(Path(os.path.realpath(other)), digest) for other in besides}
    with _alone_in(path.parent):
        try:
            for other, make in besides.items():
                if make is None:
                    staged[other].unlink(missing_ok=True)  # of a writer that was killed
                else:
                    make(staged[other], digest)
            write(path, digest)
        except BaseException:
            for one in staged.values():
                with suppress(OSError):
                    one.unlink(missing_ok=True)
            raise
        for other, make in besides.items():
            try:
                if make is None:
                    other.unlink(missing_ok=True)
                else:
                    with suppress(FileNotFoundError):  # a reader has done it
                        _take_place(staged[other], other)
            except OSError as error:
                raise OptionsError(f'{other}: belongs to an older {path.name}; it cannot '
                                   f'be removed: {error.strerror}; remove it') from error


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other writers of sets out of a folder meanwhile, where its file system can.

    OSError: another program keeps this one out for long, such as a process that was stopped.
    """
    descriptor, deadline = os.open(folder, os.O_RDONLY | os.O_CLOEXEC), time.monotonic() + _TURN_S
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise OSError(errno.EBUSY, 'another program has been writing there for '
                                               f'{_TURN_S:g} s') from None
                time.sleep(_TURN_POLL_S)
            except OSError:  # some network file systems lock no folder
                break
            else:
                break
        yield
    finally:
        os.close(descriptor)


def finish_set(path: Path, digest: str) -> None:
    """Put in place what a killed writer left of the set of a file, where that is allowed."""
    pattern = f'{glob.escape(_staged(path.with_suffix(""), digest).name)}.*'
    for staged in path.parent.glob(pattern) if digest else ():
        with suppress(OSError):  # the writer has done it meanwhile, or the folder is read-only
            _take_place(staged, staged.with_name(staged.name.removeprefix(f'.{digest}.')))


def _staged(path: Path, digest: str) -> Path:
    return path.with_name(f'.{digest}.{path.name}')


def make_folder(folder: Path) -> None:
    """Create the output folder and its parents.

    OptionsError: the folder cannot be created or written to, or its disk is full.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.{secrets.token_hex(6)}.probe'
        try:
            probe.write_bytes(bytes(_PROBE_BYTES))
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        raise OptionsError(f'{folder}: cannot be written to: {error.strerror}; {MAKE_ROOM}'
                           ) from error


def write_text(path: Path, text: str) -> None:
    """Write a file in one step; OptionsError: it cannot be written, and nothing is left."""
    write_file(path, lambda partial: partial.write_text(text, encoding='utf-8'))


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let a function write a file, which gets its name only when it is complete.

    The function takes the path to write to, which has the suffix of the file. OptionsError: the
    file cannot be written, and nothing is left.
    """
    try:
        with replace_file(path) as partial:
            write(partial)
    except OSError as error:
        raise OptionsError(f'{path}: cannot be written: {error.strerror}; {MAKE_ROOM}') from error


def warn_not_kept(text: str) -> None:
    """Warn that something could not be kept in a cache, and remember that for `prepare`."""
    NOT_KEPT.append(text)
    logger.warning('%s', text)


def resolve_cache_dir(cache_dir: str) -> Path:
    """Return the folder for downloads, label embeddings and kernels; '' means the user's cache.

    That is ``$XDG_CACHE_HOME/cliploc_ros``, else ``~/.cache/cliploc_ros``. A forged label
    embedding leads to wrong poses, a forged kernel runs code. So if the user has no home folder,
    or other users own the cache or can write to it, a private folder replaces it until the process
    ends.
    """
    if cache_dir:
        return Path(cache_dir).expanduser().absolute()
    # platformdirs would be one more dependency for these two lines
    xdg = os.environ.get('XDG_CACHE_HOME', '')
    try:
        folder = (Path(xdg) if Path(xdg).is_absolute() else Path.home() / '.cache') / 'cliploc_ros'
    except RuntimeError:
        return _process_cache('there is no home folder')
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError:  # the first write reports it
        return folder
    if is_foreign(status, {os.getuid()}):
        return _process_cache(f'other users own {folder} or can write to it')
    return folder


def is_foreign(status: os.stat_result, owners: Collection[int]) -> bool:
    """Return whether others than some owners can write to a file or folder, or own it.

    The group of this process is its user's own, in any other one may be anyone.
    """
    return (status.st_uid not in owners or bool(status.st_mode & stat.S_IWOTH)
            or (bool(status.st_mode & stat.S_IWGRP) and status.st_gid not in (os.getgid(), 0)))


@cache
def _process_cache(reason: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix='cliploc_ros_cache_'))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    logger.warning('%s: downloads and results are cached in %s until this process ends; set '
                   'cache_dir to keep them', reason, folder)
    return folder
