# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of all studies."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.offline.evaluation.summary import wilson_interval

#: Bounds of the confidences that are counted together.
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)
#: Errors of poses that lead a robot astray, though they may be no false accepts.
FAR_M, FAR_DEG = 0.5, 20.0
#: Confidences (n,), and whether each pose is right (n,).
Judged = tuple[NDArray[np.float64], NDArray[np.bool_]]


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ['---'] * len(columns), *rows]
    return '\n'.join(f'| {" | ".join(map(str, cells))} |' for cells in lines)


def interval(count: float, total: int, digits: int = 2) -> str:
    """Return the 95 % interval of a share, after Wilson."""
    low, high = wilson_interval(count, total) if total else (0.0, 1.0)
    return f'{low:.{digits}f} to {high:.{digits}f}'


def mean(values: NDArray[Any], digits: int = 3) -> str:
    """Return the mean of some values; nothing without values."""
    return f'{values.mean():.{digits}f}' if len(values) else ''


def draw_judged(folder: Path, title: str, judged: Mapping[str, Judged]) -> None:
    """Draw a reliability diagram: reliability.png in a folder."""
    # late, since tables need no matplotlib
    from cliploc_ros.files.storage import make_folder
    from cliploc_ros.offline.evaluation.figures import (
        add_legend,
        draw_reliability,
        new_axes,
        save_figure,
    )

    make_folder(folder)
    figure, axes = new_axes('confidence', f'share of poses within {RIGHT_M:g} m')
    draw_reliability(axes, judged)
    axes.set_title(title, fontsize=9)
    add_legend(figure)
    print(f'wrote {save_figure(figure, folder / "reliability.png")}')
