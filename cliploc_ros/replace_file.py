# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write a file in one step: it is there complete, or the old one stays."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that becomes ``path`` when the block ends.

    The temporary file lies in the same folder and has the same suffix. It is flushed to disk
    before it replaces the old file, so that not even a power cut leaves half a file. An exception
    removes it, and the old file stays. A symbolic link is followed and stays, and an existing
    file keeps its mode.

    Raises
    ------
    OSError
        The folder is missing, read-only or full.
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
