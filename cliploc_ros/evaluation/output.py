# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files: each is written completely, or not at all."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.trials import Query, Result
from cliploc_ros.files.storage import replace_file
from cliploc_ros.units import NS_PER_S

GROUND_TRUTH = 'ground_truth.txt'


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


def write_trajectories(folder: Path, queries: Sequence[Query], results: Sequence[Result]) -> None:
    """Write ground_truth.txt, METHOD.txt and METHOD.accepted.txt of each method's first trial."""
    make_folder(folder)
    write_text(folder / GROUND_TRUTH, _text(
        (query.observation.stamp_ns / NS_PER_S, query.map_from_camera) for query in queries))
    for method in dict.fromkeys(result.method for result in results):
        found = [(one, np.array(one.map_from_camera)) for one in results
                 if one.method == method and one.trial == 0 and one.solved]
        write_text(folder / f'{method}.txt', _text((one.timestamp, pose) for one, pose in found))
        write_text(folder / f'{method}.accepted.txt',
                   _text((one.timestamp, pose) for one, pose in found if one.accepted))


def _text(poses: Iterable[tuple[float, NDArray[np.float64]]]) -> str:
    lines = ['# timestamp tx ty tz qx qy qz qw']
    for timestamp, pose in sorted(poses, key=lambda one: one[0]):
        numbers = [*pose[:3, 3], *quaternion_from_transform(pose)]
        lines.append(' '.join([f'{timestamp:.6f}', *(f'{number:.9f}' for number in numbers)]))
    return '\n'.join(lines) + '\n'
