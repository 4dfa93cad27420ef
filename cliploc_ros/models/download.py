# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Downloads of weights: the libraries fetch the files, and every failure says what to do."""

import errno
import logging
from collections.abc import Callable
from pathlib import Path

from cliploc_ros.errors import ModelError

logger = logging.getLogger(__name__)


def download(what: str, folder: Path, remedy: str, fetch: Callable[[], str | Path]) -> Path:
    """Download a file with a library's own function.

    Parameters
    ----------
    what : str
        Name of the file or weights, for the log and the error.
    folder : Path
        Where the file goes; made if it does not exist.
    remedy : str
        What the user can do without a network, for the error.
    fetch : callable
        Downloads the file and returns its path. It must leave no partial file under that path.

    Raises
    ------
    ModelError
        When the download fails.
    """
    logger.info('downloading %s into %s', what, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return Path(fetch())
    except Exception as error:  # each library raises exceptions of its own
        raise ModelError(f'cannot download {what}: {_reason(error, folder)}. {remedy}; or run '
                         'prepare --cache-dir there, and set cache_dir to a copy of its folder'
                         ) from error


def _reason(error: Exception, folder: Path) -> str:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f'the disk of {folder} is full: make room, or set cache_dir to another disk'
    return f'{type(error).__name__}: {first_line(error).rstrip(".")}'


def first_line(error: Exception) -> str:
    """Return the first line of a library's message in ASCII; some hold emojis and colours."""
    lines = str(error).encode('ascii', 'ignore').decode().strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__
