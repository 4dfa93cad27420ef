# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Coefficients of the confidence that fit what searches found and what of it was right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cliploc_ros.core.acceptance.calibration import CALIBRATION, Calibration, Objects
from cliploc_ros.core.acceptance.confidence import (
    Setting,
    confidences,
    none_right,
    utilities,
)
from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.geometry.tolerances import RIGHT_M, SAME_ANSWER
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.summary import wilson_interval

#: Confidences (n,), and whether each pose is right (n,).
Judged = tuple[NDArray[np.float64], NDArray[np.bool_]]
_THRESHOLDS = (0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
_PRECISION = 0.99
_FIELDS = ('score', 'misfit', 'likeness', 'rarity', 'unlabelled', 'unexplained')
# Support must not count against a pose, whatever a small data set says. A larger map has more
# wrong poses, a vertical leaves fewer.
_SIGNS = ((0, None), (None, 0), (0, None), (0, None), (0, None), (None, 0), (None, None),
          (0, None), (None, 0))
_KNEES = (0.0, 0.5, 1.0, 1.5, 2.0)
_MOST_SLOPE = 3.0
_RIDGE = 1e-4
# Poses at a place that the map does not show count in full for the coefficients of the support:
# they say best what a wrong pose looks like. Robots rarely start there, so they count by this
# share for the level of the confidence. A guess.
_ELSEWHERE = 0.1


@dataclass(frozen=True)
class Case:
    """The hypotheses of a search, and which of them are right.

    Parameters
    ----------
    place : str
        Searches at one place stay in one part of a cross-validation.
    supports : tuple of m Support
    poses : ndarray (m, 4, 4)
    right : ndarray (m,) of bool
    handicaps : ndarray (m,)
        See confidences.
    setting : Setting
    weight : float
        In the fit.
    is_elsewhere : bool
        Whether the map shows another place, so that every pose is wrong.
    certainty : float
        That nothing besides the poses found makes the best one wrong, see Evidence.
    """

    place: str
    supports: tuple[Support, ...]
    poses: NDArray[np.float64]
    right: NDArray[np.bool_]
    handicaps: NDArray[np.float64]
    setting: Setting
    weight: float = 1.0
    is_elsewhere: bool = False
    certainty: float = 1.0


def judge(found: Relocalization, map_from_camera: NDArray[np.float64], place: str,
          setting: Setting, weight: float = 1.0, is_elsewhere: bool = False) -> Case:
    """Return the hypotheses of a search, compared with the true pose (4, 4)."""
    poses = np.array([one.map_from_camera for one in found.hypotheses])
    errors = np.array([pose_error(pose, map_from_camera)[0] for pose in poses])
    return Case(place, tuple(one.support for one in found.hypotheses), poses,
                (errors < RIGHT_M) & (not is_elsewhere),
                np.array([one.handicap for one in found.hypotheses]), setting, weight,
                is_elsewhere, 1.0 if found.evidence is None
                else found.evidence.certainty * found.evidence.found)


def outcomes(cases: Sequence[Case], calibration: Calibration = CALIBRATION) -> Judged:
    """Return the confidence (n,) in the likeliest pose of each case, and whether it is right."""
    likely, right = [], []
    for case in cases:
        lead = _lead(case, calibration)
        likely.append(case.certainty * confidences(
            utilities(case.supports, calibration) - case.handicaps, case.poses,
            none_right(case.setting, calibration), calibration)[lead])
        right.append(case.right[lead])
    return np.array(likely), np.array(right, dtype=bool)


def _lead(case: Case, calibration: Calibration) -> int:
    """Return which hypothesis leads; one that contradicts a known vertical never does."""
    odds = utilities(case.supports, calibration) - case.handicaps
    if case.setting.vertical > 0.0:
        odds = np.where(case.handicaps < CALIBRATION.attitude.wrong_mount, odds, -np.inf)
    return int(np.argmax(odds))


def fit(cases: Sequence[Case]) -> Calibration:
    """Return the coefficients of maximum likelihood.

    First the utilities. Then the level of the confidence: the utility of the case that none is
    right, and slope and knee. What all cases have in common, such as the size of a single map,
    keeps its installed coefficient.

    Parameters
    ----------
    cases : sequence of Case

    Raises
    ------
    OptionsError
        All poses are right, or all are wrong.
    """
    first = np.array([case.right[0] for case in cases], dtype=bool)
    if first.all() or not first.any():
        raise OptionsError(f'{first.sum()} of {len(first)} poses are right; a fit needs right and '
                           'wrong ones')
    data = _arrays(cases)
    scale = np.append(data.supports[data.given].std(axis=0) + 1e-9, np.ones(3))
    bounds = list(_SIGNS)
    installed = CALIBRATION.objects
    start = np.append(np.zeros(len(_FIELDS)), [1.0, installed.map_size, installed.vertical])
    for column in (1, 2):  # size of the map, vertical
        if np.ptp(data.settings[:, column]) == 0.0:
            row = len(_FIELDS) + column
            bounds[row] = (start[row], start[row])
    solved = minimize(_loss, start, (data, scale), jac=True, method='L-BFGS-B', bounds=bounds)
    return _levelled(cases, CALIBRATION._replace(
        objects=Objects(*map(float, [*solved.x / scale, 0.0, 0.0]))))


def _levelled(cases: Sequence[Case], raw: Calibration) -> Calibration:
    """Return coefficients with the level, knee and slope of maximum likelihood."""
    weights = np.array([case.weight * (_ELSEWHERE if case.is_elsewhere else 1.0)
                        for case in cases])
    certainty = np.array([case.certainty for case in cases])
    leads = [_lead(case, raw) for case in cases]
    right = np.array([case.right[lead] for case, lead in zip(cases, leads, strict=True)])
    own, every, none = np.array([_log_odds(case, lead, raw)
                                 for case, lead in zip(cases, leads, strict=True)]).T

    def surprise(level: NDArray[np.float64], knee: float) -> float:
        log_odds = own - np.logaddexp(_without(every, own), none + level[0])
        log_odds += np.clip(level[1], 0.0, _MOST_SLOPE) * np.maximum(0.0, log_odds - knee)
        likely = np.clip(certainty / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))), 1e-4,
                         1.0 - 1e-4)
        return float(-weights @ np.log(np.where(right, likely, 1.0 - likely)) / weights.sum())

    solutions = [minimize(surprise, [0.0, 0.5], (knee,), method='Nelder-Mead')
                 for knee in _KNEES]
    best = int(np.argmin([one.fun for one in solutions]))
    shift, slope = solutions[best].x
    return raw._replace(objects=raw.objects._replace(
        none_right=raw.objects.none_right + float(shift), knee=_KNEES[best],
        slope=float(np.clip(slope, 0.0, _MOST_SLOPE))))


def _log_odds(case: Case, lead: int, calibration: Calibration) -> tuple[float, float, float]:
    """Return the utilities of the leading place, of all hypotheses, and of none being right."""
    odds = utilities(case.supports, calibration) - case.handicaps
    agreeing = SAME_ANSWER.agreeing(case.poses)[lead]
    return (float(np.logaddexp.reduce(odds[agreeing])), float(np.logaddexp.reduce(odds)),
            none_right(case.setting, calibration))


def _without(every: NDArray[np.float64], own: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log(exp(every) - exp(own))."""
    share = -np.expm1(np.minimum(own - every, 0.0))
    return every + np.log(np.maximum(share, 1e-300))


class _Arrays(NamedTuple):
    """Cases as arrays: n of them, of up to h hypotheses each.

    Parameters
    ----------
    supports : ndarray (n, h, 6)
    given : ndarray (n, h) of bool
        Which hypotheses exist.
    right : ndarray (n, h) of bool
    handicaps : ndarray (n, h)
    settings : ndarray (n, 3)
        1, size of the map, vertical.
    weights : ndarray (n,)
        Their sum is 1.
    """

    supports: NDArray[np.float64]
    given: NDArray[np.bool_]
    right: NDArray[np.bool_]
    handicaps: NDArray[np.float64]
    settings: NDArray[np.float64]
    weights: NDArray[np.float64]


def _arrays(cases: Sequence[Case]) -> _Arrays:
    shape = (len(cases), max(len(case.supports) for case in cases))
    supports, handicaps = np.zeros((*shape, len(_FIELDS))), np.zeros(shape)
    given, right = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for row, case in enumerate(cases):
        count = len(case.supports)
        supports[row, :count] = [[getattr(one, name) for name in _FIELDS]
                                 for one in case.supports]
        given[row, :count], right[row, :count] = True, case.right
        handicaps[row, :count] = case.handicaps
    weights = np.array([case.weight for case in cases])
    return _Arrays(supports, given, right, handicaps, np.array(
        [[1.0, case.setting.map_size, case.setting.vertical] for case in cases]),
        weights / weights.sum())


def _loss(coefficients: NDArray[np.float64], data: _Arrays, scale: NDArray[np.float64]
          ) -> tuple[float, NDArray[np.float64]]:
    """Return the negative log likelihood and its derivatives (9,) by the coefficients."""
    supports, settings = data.supports / scale[:-3], data.settings / scale[-3:]
    utility = np.where(data.given, supports @ coefficients[:-3] - data.handicaps, -1e9)
    utility = np.column_stack([utility, settings @ coefficients[-3:]])
    odds = np.exp(utility - utility.max(axis=1, keepdims=True))
    truth = np.column_stack([data.right, ~data.right.any(axis=1)])
    share = odds / odds.sum(axis=1, keepdims=True)
    true_share = odds * truth + 1e-300
    likely = true_share.sum(axis=1) / odds.sum(axis=1)
    pull = share - true_share / true_share.sum(axis=1, keepdims=True)
    pull *= data.weights[:, None]
    gradient = np.append(np.einsum('nh,nhk->k', pull[:, :-1] * data.given, supports),
                         pull[:, -1] @ settings)
    shrink = _RIDGE * np.append(coefficients[:-3], np.zeros(3))
    return float(-data.weights @ np.log(likely) + shrink @ coefficients / 2), gradient + shrink


def report(name: str, likely: NDArray[np.float64], right: NDArray[np.bool_]) -> str:
    """Return precision and recall of some thresholds, and the best recall of any."""
    lines = [f'{name}: {len(right)} poses, {right.sum()} of them within {RIGHT_M:g} m']
    for least in _THRESHOLDS:
        accepted = likely >= least
        false, count = int((accepted & ~right).sum()), int(accepted.sum())
        low, high = wilson_interval(count - false, count) if count else (0.0, 1.0)
        lines.append(f'  min_confidence {least:5}: {count:4} accepted, {false} of them wrong, '
                     f'precision {low:.3f} to {high:.3f} (95 %), '
                     f'recall {(accepted & right).sum() / max(int(right.sum()), 1):.3f}')
    if right.any():
        recall, least = best_recall(likely, right)
        lines.append(f'  best at precision {_PRECISION}: {least:5.3f}, recall {recall:.3f}')
    return '\n'.join(lines)


def best_recall(likely: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the best recall of any threshold with a precision of .99, and the threshold."""
    order = np.argsort(-likely, kind='stable')
    hits = np.cumsum(right[order])
    precise = np.nonzero(hits >= _PRECISION * np.arange(1, len(hits) + 1))[0]
    if not len(precise):
        return 0.0, 1.0
    return float(hits[precise[-1]] / hits[-1]), float(likely[order[precise[-1]]])


def paste(calibration: Calibration) -> str:
    """Return the coefficients for the installed file."""
    return '\nfitted on all of them, for calibration.yaml, objects:\n' + ', '.join(
        f'{name}: {value:.3g}' for name, value in calibration.objects._asdict().items())


def draw_judged(folder: Path, title: str, judged: Mapping[str, Judged]) -> None:
    """Draw a reliability diagram: reliability.png in a folder."""
    # late, since the fit needs no matplotlib
    from cliploc_ros.evaluation.figures import add_legend, new_axes, save_figure
    from cliploc_ros.evaluation.output import make_folder
    from cliploc_ros.evaluation.trust import draw_reliability

    make_folder(folder)
    figure, axes = new_axes('confidence', f'share of poses within {RIGHT_M:g} m')
    draw_reliability(axes, judged)
    axes.set_title(title, fontsize=9)
    add_legend(figure)
    print(f'wrote {save_figure(figure, folder / "reliability.png")}')
