# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read untrusted files, choose and create folders, and replace files atomically."""

import atexit
import errno
import fcntl
import glob
import json
import logging
import os
import re
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

#: Maximum size of a file that is read into memory completely [bytes].
MOST_BYTES = 256 * 2**20
# Maximum number of values in a JSON text, each of which takes up to 64 bytes of memory, and of
# digits in an integer: 64 bits have 19 or 20.
_MOST_VALUES = 8_000_000
_MOST_DIGITS = 20
# Maximum wait for other writers of a folder, and polling interval [s]: writing a set takes less.
_TURN_S, _TURN_POLL_S = 30.0, 0.02
# Not 0: an empty file can be created even on a full disk.
_PROBE_BYTES = 4096
_UNFINISHED = re.compile(r'\.[0-9a-f]{12}\.part\.')
#: Advice for a file that cannot be written.
MAKE_ROOM = 'make room, or choose another folder'
#: Messages about files that this process could not cache, see warn_not_kept.
NOT_KEPT: list[str] = []


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading.

    Raises OSError if an untrusted path is not a regular file: a pipe would wait for a writer, and
    a device would never end.
    """
    try:
        mode = Path(path).stat().st_mode  # before opening, which may have effects on a device
        if stat.S_ISREG(mode):
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), 'rb')
            mode = os.fstat(file.fileno()).st_mode
            # a stream of the kernel, such as /proc/kmsg, has no size, but content or an OSError
            if stat.S_ISREG(mode) and (
                    not os.pread(file.fileno(), 1, 0) or os.fstat(file.fileno()).st_size):
                return file
            file.close()
    except ValueError as error:  # a null byte, or invalid UTF-8
        raise OSError(errno.EINVAL, f'is not a valid path: {error}') from error
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, 'a folder, not a regular file')
    raise OSError(errno.EINVAL, 'not a regular file')


def read_file(path: str | os.PathLike[str], most_bytes: int = MOST_BYTES) -> bytes:
    """Read a regular file; OSError: there is none, or it is larger than most_bytes."""
    with open_file(path) as file:
        # check the size first: that of a sparse file is not limited by the disk
        size = os.fstat(file.fileno()).st_size
        content = file.read(most_bytes + 1) if size <= most_bytes else b''
    if max(size, len(content)) > most_bytes:
        raise OSError(errno.EFBIG, f'larger than {most_bytes // 2**20} MiB')
    return content


def parse_json(text: str | bytes, **options: Any) -> Any:
    """Parse a JSON text, see json.loads.

    Raises ValueError if it is not JSON, or if its nesting, its number of values or its integers
    exceed what any supported program writes.
    """
    marks = (b',', b'[', b'{') if isinstance(text, bytes) else (',', '[', '{')
    if sum(map(text.count, marks)) > _MOST_VALUES:  # type: ignore[arg-type]
        raise ValueError(f'contains more than {_MOST_VALUES} values')
    try:
        return json.loads(text, parse_int=_integer, **options)
    except RecursionError as error:
        raise ValueError('is nested too deeply') from error


def _integer(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f'contains an integer of {len(digits)} digits')
    return int(digits)


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that becomes ``path`` when the block ends.

    The temporary file is in the same folder and has the same suffix. It is flushed to disk before
    it replaces the old file, so that even a power failure does not leave a partial file. After an
    exception, it is removed and the old file is kept. A symbolic link is followed and kept, and an
    existing file keeps its mode.

    Raises OSError if the folder is missing, read-only or full.
    """
    path = Path(os.path.realpath(path))
    with unfinished(path) as partial:
        yield partial
        with partial.open('rb+') as file:
            os.fsync(file.fileno())
        _take_place(partial, path)


@contextmanager
def unfinished(path: Path, make: Callable[[Path], object] = Path.touch) -> Iterator[Path]:
    """Yield the path of a new hidden file beside ``path``, which is removed when the block ends.

    ``make`` creates it: Path.mkdir gives a folder. If this process is killed, the next writer of
    any file in the folder removes it. It is locked, so no other process removes it before.

    Raises OSError if the folder is missing, read-only or full.
    """
    with suppress(OSError):  # the folder is missing, or cannot be listed
        for entry in path.parent.iterdir():
            if _UNFINISHED.match(entry.name):
                with suppress(OSError):  # its writer lives, or this file system has no locks
                    descriptor = _lock(entry, fcntl.LOCK_EX)
                    _remove(entry)
                    os.close(descriptor)
    descriptor = -1
    while descriptor < 0:
        # random, because containers that share the folder may have processes of equal number
        place = path.with_name(f'.{secrets.token_hex(6)}.part.{path.name}')
        make(place)
        with suppress(FileNotFoundError, BlockingIOError):  # removed before it was locked
            descriptor = _lock(place, fcntl.LOCK_SH)
    try:
        yield place
    finally:
        _remove(place)
        os.close(descriptor)


def _lock(place: Path, kind: int) -> int:
    """Open a file or folder and lock it without waiting; return the descriptor.

    Raises OSError if it is missing, or locked by another process, or if it cannot be locked.
    """
    descriptor = os.open(place, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        place.stat()
    except OSError as error:
        # some file systems have no locks: there, nobody removes the files of others
        if kind == fcntl.LOCK_SH and not isinstance(error, FileNotFoundError | BlockingIOError):
            return descriptor
        os.close(descriptor)
        raise
    return descriptor


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place, ignore_errors=True)
    else:
        with suppress(OSError):
            place.unlink()


def _take_place(partial: Path, path: Path) -> None:
    """Replace a file by another file, keeping its mode; a symbolic link is followed."""
    path = Path(os.path.realpath(path))
    with suppress(OSError):  # there is no file yet, or the file system has no modes
        partial.chmod(stat.S_IMODE(path.stat().st_mode))
    partial.replace(path)


#: Writes a file to a path, with the digest of its set in the content.
WriteOfSet = Callable[[Path, str], object]


def replace_set(path: Path, digest: str, write: WriteOfSet,
                besides: Mapping[Path, WriteOfSet | None]) -> None:
    """Write a file and the files beside it atomically: a kill at any time leaves a complete set.

    The files beside it are first written under temporary names. The file itself is then replaced
    atomically, which makes the new set valid; after a kill, finish_set renames the remaining
    files. Files of other sets are recognized by their digest. Writers of one folder take turns.

    Parameters
    ----------
    besides : mapping
        The other files in the same folder; None removes a file.

    Raises
    ------
    OSError
        Nothing was changed. The callables may raise other exceptions, with the same effect.
    OptionsError
        The set was written, but a file of an older set cannot be removed.
    """
    staged = {other: _staged(Path(os.path.realpath(other)), digest) for other in besides}
    with _alone_in(path.parent) as is_alone:
        try:
            for other, make in besides.items():
                if make is None:
                    staged[other].unlink(missing_ok=True)  # left by a killed writer
                else:
                    make(staged[other], digest)
            write(path, digest)
        except BaseException:
            for unfinished in staged.values():
                with suppress(OSError):
                    unfinished.unlink(missing_ok=True)
            raise
        for other, make in besides.items():
            try:
                if make is None:
                    other.unlink(missing_ok=True)
                else:
                    with suppress(FileNotFoundError):  # a reader has already renamed it
                        _take_place(staged[other], other)
            except OSError as error:
                raise OptionsError(f'{other}: belongs to an older {path.name} and cannot be '
                                   f'removed ({error.strerror}); remove it') from error
        # Remove what killed writers left. NAME.OTHER.X.Y stays: NAME.OTHER may have a set, too.
        names = '|'.join([rf'{re.escape(path.stem)}\.[^.]+\.[^.]+', *(
            re.escape(place.name.removeprefix(f'.{digest}.')) for place in staged.values())])
        for folder in {place.parent for place in staged.values()} if is_alone else ():
            with suppress(OSError):  # it cannot be listed
                for entry in folder.iterdir():
                    if re.fullmatch(rf'\.[0-9a-f]{{12}}\.({names})', entry.name):
                        _remove(entry)


@contextmanager
def _alone_in(folder: Path) -> Iterator[bool]:
    """Hold a lock on a folder against other writers of sets; yield whether that is possible.

    Raises OSError if another program holds the lock for long, for example a suspended process.
    """
    descriptor, deadline = os.open(folder, os.O_RDONLY | os.O_CLOEXEC), time.monotonic() + _TURN_S
    try:
        can_lock = True
        while can_lock:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise OSError(errno.EBUSY, 'another program has been writing there for '
                                               f'{_TURN_S:g} s') from None
                time.sleep(_TURN_POLL_S)
            except OSError:  # some network file systems cannot lock folders
                can_lock = False
        yield can_lock
    finally:
        os.close(descriptor)


def finish_set(path: Path, digest: str) -> None:
    """Complete the set of a file after a kill of its writer, if the folder is writable."""
    pattern = f'{glob.escape(_staged(path.with_suffix(""), digest).name)}.*'
    for staged in path.parent.glob(pattern) if digest else ():
        with suppress(OSError):  # another process has already done it, or the folder is read-only
            _take_place(staged, staged.with_name(staged.name.removeprefix(f'.{digest}.')))


def _staged(path: Path, digest: str) -> Path:
    return path.with_name(f'.{digest}.{path.name}')


def make_folder(folder: Path) -> None:
    """Create an output folder and its parents.

    Raises OptionsError if the folder cannot be created or written to, or its disk is full.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with unfinished(folder / 'probe') as probe:
            probe.write_bytes(bytes(_PROBE_BYTES))
    except OSError as error:
        raise OptionsError(f'{folder}: cannot be written to: {error.strerror}; {MAKE_ROOM}'
                           ) from error


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; OptionsError: it cannot be written, and no file is left."""
    write_file(path, lambda partial: partial.write_text(text, encoding='utf-8'))


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically with a function.

    The function takes the path of a temporary file, which has the suffix of the file. Raises
    OptionsError if the file cannot be written; no temporary file is left.
    """
    try:
        with replace_file(path) as partial:
            write(partial)
    except OSError as error:
        raise OptionsError(f'{path}: cannot be written: {error.strerror}; {MAKE_ROOM}') from error


def warn_not_kept(text: str) -> None:
    """Warn that a file could not be cached, and record the warning for `doctor --prepare`."""
    NOT_KEPT.append(text)
    logger.warning('%s', text)


def resolve_cache_dir(cache_dir: str) -> Path:
    """Return the folder for downloads, label embeddings and kernels; '' gives the user's cache.

    The user's cache is ``$XDG_CACHE_HOME/cliploc_ros`` or else ``~/.cache/cliploc_ros``. A forged
    label embedding leads to wrong poses, and a forged kernel runs arbitrary code. So if the user
    has no home folder, or if other users own the cache or can write to it, a private temporary
    folder is used until the process ends.
    """
    if cache_dir:
        return Path(cache_dir).expanduser().absolute()
    # platformdirs would be a further dependency for these two lines
    xdg = os.environ.get('XDG_CACHE_HOME', '')
    try:
        folder = (Path(xdg) if Path(xdg).is_absolute() else Path.home() / '.cache') / 'cliploc_ros'
    except RuntimeError:
        return _process_cache('there is no home folder')
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError:  # reported by the first write
        return folder
    if is_foreign(status, {os.getuid()}):
        return _process_cache(f'other users own {folder} or can write to it')
    return folder


def is_foreign(status: os.stat_result, owners: Collection[int]) -> bool:
    """Check whether users other than the given owners own a file or folder or can write to it.

    The group of this process is trusted as the user's own group; any other group may have unknown
    members.
    """
    return (status.st_uid not in owners or bool(status.st_mode & stat.S_IWOTH)
            or (bool(status.st_mode & stat.S_IWGRP) and status.st_gid not in (os.getgid(), 0)))


def check_owners(folder: Path) -> None:
    """Raise a PermissionError if other users may have written to a folder of a cache.

    Trusted are this user, root and the owner of the package, which all can change it anyway.
    """
    trusted, is_ours = {os.getuid(), 0, Path(__file__).stat().st_uid}, True
    with suppress(OSError):  # reported by the first write
        is_ours = not any(is_foreign(path.stat(), trusted) for path in (folder, *folder.iterdir()))
    if not is_ours:
        raise PermissionError(errno.EACCES, 'other users own its folder or can write to it')


@cache
def _process_cache(reason: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix='cliploc_ros_cache_'))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    logger.warning('%s: downloads and results are cached in %s until this process ends; set '
                   'cache_dir to keep them', reason, folder)
    return folder
