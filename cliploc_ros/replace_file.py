# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write a file in one step: it is there complete, or the old one stays."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that becomes ``path`` when the block ends.

    The temporary file lies in the same folder. It is flushed to disk before it replaces the old
    file, so that not even a power cut leaves half a file. An exception removes it, and the old
    file stays.

    Raises
    ------
    OSError
        The folder is missing, read-only or full.
    """
    partial = path.with_name(f'.{path.name}.{os.getpid()}.partial')
    try:
        yield partial
        with partial.open('rb+') as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
