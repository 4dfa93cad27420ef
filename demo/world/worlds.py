# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find rendered worlds on disk, and hold some out of the training."""

from pathlib import Path

from cliploc_ros.errors import DatasetError


def find_worlds(folder: Path) -> list[Path]:
    """Return the worlds in a folder, in order.

    Raises
    ------
    DatasetError
        If there are fewer than two, since one is held out.
    """
    worlds = sorted(path.parent for path in folder.glob('*/truth.json'))
    if len(worlds) < 2:
        raise DatasetError(f'{folder} holds {len(worlds)} worlds, expected at least 2: make '
                           f'some with python -m demo.world.make_worlds {folder}')
    return worlds


def hold_out(worlds: list[Path]) -> tuple[list[Path], list[Path]]:
    """Split worlds into training worlds and held-out ones, the last tenth."""
    held_out = max(1, len(worlds) // 10)
    return worlds[:-held_out], worlds[-held_out:]
