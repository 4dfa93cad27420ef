# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read a file of another system: it may be anything, and of any size."""

from pathlib import Path
from stat import S_ISREG

from cliploc_ros.errors import DatasetError

MAX_FILE_BYTES = 512 * 1024 * 1024


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file that is neither empty nor too large.

    Raises
    ------
    DatasetError
        Names the file and what is wrong with it.
    """
    try:
        if not S_ISREG(path.stat().st_mode):
            raise DatasetError(f'{path}: is no file; name the file of the map')
        with path.open('rb') as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read: {error.strerror}') from error
    if len(content) > MAX_FILE_BYTES:
        raise DatasetError(f'{path}: is larger than {MAX_FILE_BYTES // 2**20} MiB; split it')
    if not content:
        raise DatasetError(f'{path}: is empty')
    return content
