# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors, tables and figures of all studies."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.files.storage import make_folder
from cliploc_ros.offline.evaluation.figures import (
    add_legend,
    draw_reliability,
    new_axes,
    save_figure,
)
from cliploc_ros.offline.evaluation.summary import wilson_interval

#: Bounds of the confidences that are counted together.
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)
#: Errors below which a pose is a success [m].
SUCCESS_M = (0.1, 0.25, 0.5, 1.0)
#: Errors of poses that lead a robot astray, though they may be no false accepts.
FAR_M, FAR_DEG = 0.5, 20.0
#: Confidences (n,), and whether each pose is right (n,).
Judged = tuple[NDArray[np.float64], NDArray[np.bool_]]


def errors_of(found: Relocalization, map_from_camera: NDArray[np.float64]
              ) -> tuple[float, float, float]:
    """Return the errors of a pose [m] [deg], and the square in its covariance; or infinities."""
    pose = found.map_from_camera
    if pose is None:
        return inf, inf, inf
    return (*pose_error(pose, map_from_camera), inf if found.covariance is None
            else normalized_square(pose, found.covariance, map_from_camera))


def grouped[One](some: Iterable[One], by: Sequence[str]) -> dict[tuple[Any, ...], list[One]]:
    """Return things in groups of equal fields."""
    groups: dict[tuple[Any, ...], list[One]] = {}
    for one in some:
        groups.setdefault(tuple(getattr(one, name) for name in by), []).append(one)
    return groups


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ['---'] * len(columns), *rows]
    return '\n'.join(f'| {" | ".join(map(str, cells))} |' for cells in lines)


def interval(count: float, total: int, digits: int = 2) -> str:
    """Return the 95 % interval of a share, after Wilson."""
    low, high = wilson_interval(count, total) if total else (0.0, 1.0)
    return f'{low:.{digits}f} to {high:.{digits}f}'


@contextmanager
def draw(path: Path, xlabel: str, ylabel: str) -> Iterator[Axes]:
    """Write what is drawn on the axes to a file."""
    make_folder(path.parent)
    figure, axes = new_axes(xlabel, ylabel)
    yield axes
    add_legend(figure)
    print(f'wrote {save_figure(figure, path)}')


def draw_judged(path: Path, title: str, judged: Mapping[str, Judged]) -> None:
    """Draw a reliability diagram."""
    with draw(path, 'confidence', f'share of poses within {RIGHT_M:g} m') as axes:
        draw_reliability(axes, judged)
        axes.set_title(title, fontsize=9)
