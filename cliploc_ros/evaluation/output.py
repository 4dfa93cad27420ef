# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files: each is written completely, or not at all."""

import os
from collections.abc import Callable
from pathlib import Path

from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import replace_file


def make_folder(folder: Path) -> None:
    """Create the output folder and its parents.

    Raises
    ------
    OptionsError
        The folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.{os.getpid()}.probe'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OptionsError(f'--out {folder}: cannot be written to: {error.strerror}') from error


def write_text(path: Path, text: str) -> None:
    """Write a file in one step.

    Raises
    ------
    OptionsError
        The file cannot be written; nothing is left behind.
    """
    write_file(path, lambda partial: partial.write_text(text, encoding='utf-8'))


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let a function write a file, which gets its name only when it is complete.

    Parameters
    ----------
    path : Path
    write : callable
        Takes the path to write to, which has the suffix of the file.

    Raises
    ------
    OptionsError
        The file cannot be written; nothing is left behind.
    """
    try:
        with replace_file(path) as partial:
            write(partial)
    except OSError as error:
        raise OptionsError(f'{path}: cannot be written: {error.strerror}') from error
