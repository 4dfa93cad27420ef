# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a watched recording: over time, and the trade of alarms."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.evaluation.figures import add_legend, new_axes, save_figure

# Okabe and Ito, see cliploc_ros.evaluation.figures.
_COLORS = {'localized': '#009E73', 'uncertain': '#E69F00', 'lost': '#D55E00'}
_ERROR, _PROBABILITY = '#555555', '#0072B2'


class Look(Protocol):
    """A WatchedLook."""

    @property
    def stamp_s(self) -> float: ...  # noqa: D102
    @property
    def state(self) -> str: ...  # noqa: D102
    @property
    def probability(self) -> float: ...  # noqa: D102
    @property
    def error_m(self) -> float | None: ...  # noqa: D102


def draw_timeline(path: Path, looks: Sequence[Look], alarms: Sequence[Look]) -> Path:
    """Draw pose error, probability, state and alarms over time; return the path."""
    figure = Figure(figsize=(8.0, 4.4), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True)
    times = np.array([one.stamp_s for one in looks]) - looks[0].stamp_s
    ends = np.append(times[1:], times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0))
    named = set[str]()
    for one, begin, end in zip(looks, times, ends, strict=True):
        below.axvspan(begin, end, color=_COLORS[one.state], alpha=0.3, linewidth=0.0,
                      label=None if one.state in named else one.state)
        named.add(one.state)
    errors = np.array([np.nan if one.error_m is None else one.error_m for one in looks])
    above.plot(times, errors, color=_ERROR, marker='.', markersize=3, linewidth=1.0)
    above.axhline(RIGHT_M, color=_ERROR, linestyle=':', linewidth=1.0)
    above.set_ylabel('error of the pose [m]')
    if np.isnan(errors).all():
        above.text(0.5, 0.5, 'the truth is unknown', transform=above.transAxes, ha='center')
    below.plot(times, [one.probability for one in looks], color=_PROBABILITY, marker='.',
               markersize=3, linewidth=1.0, label='probability')
    for limit in (CALIBRATION.watch.lost, CALIBRATION.watch.localized):
        below.axhline(limit, color=_PROBABILITY, linestyle=':', linewidth=1.0)
    for number, one in enumerate(alarms):
        for axes in (above, below):
            axes.axvline(one.stamp_s - looks[0].stamp_s, color='black', linewidth=1.2,
                         label='alarm' if number == 0 and axes is below else None)
    below.set(xlabel='time [s]', ylabel='probability that\nthe pose is right',
              ylim=(-0.03, 1.03))
    for axes in (above, below):
        axes.grid(alpha=0.3)
    add_legend(figure)
    return save_figure(figure, path)


def draw_roc(path: Path, shares: NDArray[np.float64], area: float) -> Path:
    """Draw the shares (k, 2) of right and wrong poses below each probability; return the path."""
    figure, axes = new_axes('share of right poses below', 'share of wrong poses below')
    axes.plot([0, 1], [0, 1], color='#888888', linewidth=1.0)
    axes.step(shares[:, 0], shares[:, 1], where='post', color=_PROBABILITY)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02),
             title=f'each probability as a limit of alarms; area {area:.3f}')
    return save_figure(figure, path)
