# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where files are kept, and how one takes the place of another."""

import atexit
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from cliploc_ros.errors import OptionsError

logger = logging.getLogger(__name__)


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
    partial = path.with_name(f'.{os.getpid()}.{path.name}')
    try:
        yield partial
        with partial.open('rb+') as file:
            os.fsync(file.fileno())
        with suppress(OSError):  # there is no file yet, or the file system has no modes
            partial.chmod(stat.S_IMODE(path.stat().st_mode))
        partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def make_folder(folder: Path) -> None:
    """Create the output folder and its parents.

    OptionsError: the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.{os.getpid()}.probe'
        probe.touch()
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise OptionsError(f'{folder}: cannot be written to: {error.strerror}') from error


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
        raise OptionsError(f'{path}: cannot be written: {error.strerror}') from error


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
    if status.st_uid != os.getuid() or status.st_mode & stat.S_IWOTH:
        return _process_cache(f'other users own {folder} or can write to it')
    return folder


@cache
def _process_cache(reason: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix='cliploc_ros_cache_'))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    logger.warning('%s: downloads and results are cached in %s until this process ends; set '
                   'cache_dir to keep them', reason, folder)
    return folder
