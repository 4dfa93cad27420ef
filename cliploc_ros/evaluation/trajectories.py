# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Estimates as trajectories in TUM's format, which ``evo`` reads."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.evaluation.output import make_folder, write_text
from cliploc_ros.evaluation.trials import NS_PER_S, Query, Result

GROUND_TRUTH = 'ground_truth.txt'


def write_trajectories(folder: Path, queries: Sequence[Query], results: Sequence[Result]) -> None:
    """Write ground_truth.txt, and of each method's first trial METHOD.txt and METHOD.accepted.txt.

    Parameters
    ----------
    folder : Path
    queries : sequence of Query
    results : sequence of Result
    """
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


def absolute_trajectory_error(folder: Path, method: str) -> float | None:
    """Return the root mean square of evo's absolute pose error [m] of what a method believed.

    Nothing is aligned: both are poses in the map.

    Parameters
    ----------
    folder : Path
        Of write_trajectories.
    method : str

    Returns
    -------
    float or None
        None where evo is not installed, or fewer than two poses are believed.
    """
    try:
        from evo.core import metrics, sync
        from evo.tools import file_interface
    except ImportError:
        return None
    estimate = folder / f'{method}.accepted.txt'
    if len(estimate.read_text(encoding='utf-8').splitlines()) < 3:
        return None
    truth, found = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(folder / GROUND_TRUTH),
        file_interface.read_tum_trajectory_file(estimate))
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((truth, found))
    return float(error.get_statistic(metrics.StatisticsType.rmse))
