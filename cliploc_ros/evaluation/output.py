# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where results go."""

from pathlib import Path

from cliploc_ros.errors import OptionsError


def make_folder(folder: Path) -> None:
    """Make the folder that was given for results, with its parents.

    Raises
    ------
    OptionsError
        If it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / '.writable').touch()
        (folder / '.writable').unlink()
    except OSError as error:
        raise OptionsError(f'--out {folder}: cannot be written to: {error.strerror}') from error
