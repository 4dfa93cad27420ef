# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Figures that compare confidences and covariances with the true errors."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.stats import chi2

from cliploc_ros.evaluation.summary import wilson_interval

# finer where poses are accepted
_BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0)
_FREEDOM = 6
_COLORS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
_MARKERS = 'osD^vP'


def draw_reliability(axes: Axes, judged: Mapping[str, tuple[NDArray[np.float64],
                                                            NDArray[np.bool_]]]) -> None:
    """Draw the share of right poses over confidence, with 95 % intervals.

    Parameters
    ----------
    judged : mapping of str to (ndarray (n,), ndarray (n,) of bool)
        Confidences, and whether each pose is right, by name.
    """
    axes.plot([0, 1], [0, 1], color='#888888', linewidth=1.0, label='ideal')
    for number, (name, (confidence, right)) in enumerate(judged.items()):
        bins = np.clip(np.digitize(confidence, _BINS) - 1, 0, len(_BINS) - 2)
        color = _COLORS[number % len(_COLORS)]
        for row in np.unique(bins):
            chosen = bins == row
            share, mean = right[chosen].mean(), confidence[chosen].mean()
            low, high = wilson_interval(int(right[chosen].sum()), int(chosen.sum()))
            axes.errorbar(mean, share, np.maximum([[share - low], [high - share]], 0.0),
                          color=color, capsize=2, marker=_MARKERS[number % len(_MARKERS)],
                          markersize=5, linewidth=1.0,
                          label=f'{name} ({len(right)} poses)' if row == bins.min() else None)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))


def draw_consistency(axes: Axes, nees: Mapping[str, NDArray[np.float64]]) -> None:
    """Draw the distribution of the normalized squared errors (NEES).

    Parameters
    ----------
    nees : mapping of str to ndarray (n,)
        Of accepted poses, by name, see normalized_square.
    """
    levels = np.linspace(0.0, float(chi2.ppf(0.999, _FREEDOM)), 400)
    axes.plot(levels, chi2.cdf(levels, _FREEDOM), color='#888888', linewidth=1.6,
              label='ideal')
    axes.axvline(chi2.ppf(0.95, _FREEDOM), color='#888888', linewidth=0.8, linestyle=':',
                 label='95 % ellipsoid')
    for number, (name, squares) in enumerate(nees.items()):
        if not len(squares):
            continue
        axes.plot(levels, np.searchsorted(np.sort(squares), levels, side='right') / len(squares),
                  color=_COLORS[number % len(_COLORS)], linewidth=1.4,
                  label=f'{name}: {within_ellipsoid(squares):.3f} within')
    axes.set(xlim=(0, levels[-1]), ylim=(0, 1.02))


def within_ellipsoid(squares: NDArray[np.float64], share: float = 0.95) -> float:
    """Return the share of poses within the ellipsoids that should hold a given share."""
    return float((squares < chi2.ppf(share, _FREEDOM)).mean())
