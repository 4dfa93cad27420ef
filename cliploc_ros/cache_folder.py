# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where downloads are kept, and what is computed once."""

import atexit
import logging
import os
import shutil
import stat
import tempfile
from functools import cache
from pathlib import Path

logger = logging.getLogger(__name__)


def resolve_cache_dir(cache_dir: str) -> Path:
    """Return the folder for downloads, label embeddings and kernels; '' means the user's cache.

    That is ``$XDG_CACHE_HOME/cliploc_ros``, else ``~/.cache/cliploc_ros``. A forged label
    embedding leads to wrong poses, a forged kernel runs code. So if the user has no home folder,
    or other users own the cache or can write to it, a private folder replaces it until the process
    ends.
    """
    if cache_dir:
        return Path(cache_dir).expanduser().absolute()
    try:
        folder = _user_cache()
    except RuntimeError:
        return _process_cache('there is no home folder')
    if _is_open_to_others(folder):
        return _process_cache(f'other users own {folder} or can write to it')
    return folder


def _user_cache() -> Path:
    """Return the user's cache of this package; raise RuntimeError where no home is known."""
    xdg = os.environ.get('XDG_CACHE_HOME', '')
    parent = Path(xdg) if Path(xdg).is_absolute() else Path.home() / '.cache'
    return parent / 'cliploc_ros'


def _is_open_to_others(folder: Path) -> bool:
    """Return whether others own or can write to a folder, which is made if it does not exist."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError:  # the first write reports it
        return False
    return status.st_uid != os.getuid() or bool(status.st_mode & stat.S_IWOTH)


@cache
def _process_cache(reason: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix='cliploc_ros_cache_'))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    logger.warning('%s: downloads and results are cached in %s until this process ends; set '
                   'cache_dir to keep them', reason, folder)
    return folder
