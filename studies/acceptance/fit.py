# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit the confidence to simulated worlds.

Each group of images is localized in all modes, by labels and by classes, and in the same map with
all objects exchanged, where every pose is wrong. Half of the worlds have an error that all objects
share: of the focal length, of the map's size or shape, or of names. For the report, each kind of
world is judged with coefficients that were fitted to the other kinds. The coefficients printed at
the end are fitted to rooms, offices, shops and bare rooms. Corridors, halls and twin rooms are
only judged: cliploc_ros.core.acceptance.look_alikes handles their mistaken places.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    confidences,
    none_right,
    utilities,
)
from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.geometry.transforms import RIGHT_M, SAME_ANSWER, pose_error
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.errors import OptionsError
from studies.acceptance.places import ALL, MODES, ONE, Simulated
from studies.acceptance.troubles import FAMILIES, exchange_landmarks
from studies.reports import Answer, Judged, confidence_table

#: The kinds of worlds in the fit; the other kinds have places that look alike.
FITTED_KINDS = ('room', 'office', 'shop', 'bare room')
MATCHINGS = ('hybrid', 'class')
# Deviations of the known vertical [deg]; one is drawn for each world.
_VERTICALS_DEG = (0.5, 1.0, 2.0, 4.0)
# So low that evidence computed only for likely poses also exists for doubtful ones.
_IN_DOUBT = 0.3
# Errors that objects share, with their deviations or levels; half of the worlds have one.
_SHARED = {'B focal length off by a factor': 0.03, 'C map scaled by': 0.05,
           'C half of the map moved by [m]': 0.3, 'A landmarks under other classes, copies': 1}
_THRESHOLDS = (0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
_FIELDS = ('score', 'misfit', 'likeness', 'rarity', 'unlabelled', 'unexplained', 'depth')
_TERMS = (*_FIELDS, 'none_right', 'map_size', 'vertical')
# Bounds of the coefficients. Support must never lower the confidence of a pose, even if a small
# data set suggests it. A larger map has more wrong poses; a vertical excludes some of them.
_SIGNS = ((0, None), (None, 0), (0, None), (0, None), (0, None), (None, 0), (0, None),
          (None, None), (0, None), (None, 0))
_KNEES = (0.0, 0.5, 1.0, 1.5, 2.0)
_MOST_SLOPE = 3.0
_RIDGE = 1e-4
# Poses at a place outside the map have full weight for the coefficients of the support: they are
# the best examples of wrong poses. Robots rarely start there, so they have this weight for the
# level of the confidence. Chosen.
_ELSEWHERE = 0.1


@dataclass(frozen=True)
class Case:
    """The m hypotheses of a search, and which of them are correct."""

    supports: tuple[Support, ...]
    poses: NDArray[np.float64]
    right: NDArray[np.bool_]
    handicaps: NDArray[np.float64]  # see confidences
    setting: Setting
    is_elsewhere: bool = False  # the map shows another place, so every pose is wrong
    certainty: float = 1.0  # factor of the confidence for causes of error beyond the hypotheses


def judge(found: Relocalization, map_from_camera: NDArray[np.float64], setting: Setting,
          is_elsewhere: bool = False) -> Case:
    """Compare the hypotheses of a search with the true pose (4, 4)."""
    poses = np.array([hypothesis.map_from_camera for hypothesis in found.hypotheses])
    errors = np.array([pose_error(pose, map_from_camera)[0] for pose in poses])
    return Case(tuple(hypothesis.support for hypothesis in found.hypotheses), poses,
                (errors < RIGHT_M) & (not is_elsewhere),
                np.array([hypothesis.handicap for hypothesis in found.hypotheses]), setting,
                is_elsewhere, 1.0 if found.evidence is None
                else found.evidence.certainty * found.evidence.found)


class Searched(NamedTuple):
    """The case of one search, with the kind of world, the mode and the matching."""

    kind: str
    mode: str
    matching: str
    case: Case


def make_search_world() -> Callable[[Simulated], list[Searched]]:
    """Return the function that searches a world, for a worker."""
    return search_world


def search_world(world: Simulated) -> list[Searched]:
    """Return the cases of a world in all modes.

    Queries are independent questions: no evidence about the camera, and no looks before.
    """
    kind, seed = world.kind, world.seed
    place, rng = world.load(), np.random.default_rng([seed, 7])
    vertical_deg = float(rng.choice(_VERTICALS_DEG))
    shared = str(rng.choice([*_SHARED, *[''] * len(_SHARED)]))
    level = _level(shared, rng) if shared else 0.0
    found = []
    for matching in MATCHINGS:
        plain = RelocalizerOptions(matching=matching, vertical_deviation_deg=vertical_deg,
                                   min_confidence=_IN_DOUBT)
        for mode in MODES:
            queries, options = place.ask(mode, seed, vertical_deg), place.options(mode, plain)
            setting = Setting(len(place.landmark_map),
                              vertical_deg if 'vertical' in mode else math.inf)
            shown = place.landmark_map
            if shared:
                shown, changed = FAMILIES[shared].change(shown, queries, level,
                                                         np.random.default_rng([seed, 8]))
                queries = list(changed)
            maps = [(shown, False)]
            if mode in (ONE, ALL):
                maps.append((exchange_landmarks(shown, queries, 1.0, rng)[0], True))
            for landmark_map, is_elsewhere in maps:
                relocalizer = Relocalizer(landmark_map, options)
                for query in queries:
                    result = relocalizer.relocalize([*query.neighbours, query.observation])
                    if result.solved:
                        found.append(Searched(kind, mode, matching, judge(
                            result, query.map_from_camera, setting, is_elsewhere)))
    return found


def _level(shared: str, rng: np.random.Generator) -> float:
    """Draw the size of a world's error: a factor near 1, a distance, or a number of copies."""
    deviation = _SHARED[shared]
    if isinstance(deviation, int):
        return deviation
    return float(rng.normal('[m]' not in shared, deviation))


def fit(cases: Sequence[Case], only: str = '') -> Calibration:
    """Return the maximum-likelihood coefficients; with ``only``, fit one of the support's terms.

    The utilities are fitted first, then the level of the confidence: the utility of the case that
    no hypothesis is correct, slope and knee. Terms with the same value in all cases, such as the
    size of a single map, keep their installed coefficient.

    Raises
    ------
    OptionsError
        All poses are correct, or all are wrong.
    """
    first = np.array([case.right[0] for case in cases], dtype=bool)
    if first.all() or not first.any():
        raise OptionsError(f'{first.sum()} of {len(first)} poses are correct; a fit needs both '
                           'correct and wrong poses')
    data = _arrays(cases)
    scale = np.append(data.supports[data.given].std(axis=0) + 1e-9, np.ones(3))
    bounds = list(_SIGNS)
    installed = np.array([getattr(CALIBRATION.objects, name) for name in _TERMS]) * scale
    start = np.append(np.zeros(len(_FIELDS)), [1.0, *installed[-2:]])
    varies = np.append(np.ptp(data.supports[data.given], axis=0),
                       [1.0, *np.ptp(data.settings[:, 1:], axis=0)]) > 0.0
    for row, name in enumerate(_TERMS):
        if not varies[row] or (only and name != only):
            start[row], bounds[row] = installed[row], (installed[row], installed[row])
    solved = minimize(_loss, start, (data, scale), jac=True, method='L-BFGS-B', bounds=bounds)
    if only:
        fitted = float((solved.x / scale)[_TERMS.index(only)])
        return CALIBRATION._replace(objects=CALIBRATION.objects._replace(**{only: fitted}))
    fitted_terms = dict(zip(_TERMS, map(float, solved.x / scale), strict=True))
    return _levelled(cases, CALIBRATION._replace(
        objects=CALIBRATION.objects._replace(**fitted_terms, knee=0.0, slope=0.0)))


class _Arrays(NamedTuple):
    """Cases as arrays: n of them, of up to h hypotheses each."""

    supports: NDArray[np.float64]  # (n, h, 7)
    given: NDArray[np.bool_]  # (n, h): which hypotheses exist
    right: NDArray[np.bool_]  # (n, h)
    handicaps: NDArray[np.float64]  # (n, h)
    settings: NDArray[np.float64]  # (n, 3): 1, size of the map, vertical


def _arrays(cases: Sequence[Case]) -> _Arrays:
    shape = (len(cases), max(len(case.supports) for case in cases))
    supports, handicaps = np.zeros((*shape, len(_FIELDS))), np.zeros(shape)
    given, right = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for row, case in enumerate(cases):
        count = len(case.supports)
        supports[row, :count] = [[getattr(support, name) for name in _FIELDS]
                                 for support in case.supports]
        given[row, :count], right[row, :count] = True, case.right
        handicaps[row, :count] = case.handicaps
    return _Arrays(supports, given, right, handicaps, np.array(
        [[1.0, case.setting.map_size, case.setting.vertical] for case in cases]))


def _loss(coefficients: NDArray[np.float64], data: _Arrays, scale: NDArray[np.float64]
          ) -> tuple[float, NDArray[np.float64]]:
    """Return the negative log likelihood and its gradient (10,)."""
    supports, settings = data.supports / scale[:-3], data.settings / scale[-3:]
    utility = np.where(data.given, supports @ coefficients[:-3] - data.handicaps, -1e9)
    utility = np.column_stack([utility, settings @ coefficients[-3:]])
    odds = np.exp(utility - utility.max(axis=1, keepdims=True))
    truth = np.column_stack([data.right, ~data.right.any(axis=1)])
    share = odds / odds.sum(axis=1, keepdims=True)
    true_share = odds * truth + 1e-300
    likely = true_share.sum(axis=1) / odds.sum(axis=1)
    weights = np.ones(len(odds)) / len(odds)
    pull = share - true_share / true_share.sum(axis=1, keepdims=True)
    pull *= weights[:, None]
    gradient = np.append(np.einsum('nh,nhk->k', pull[:, :-1] * data.given, supports),
                         pull[:, -1] @ settings)
    shrink = _RIDGE * np.append(coefficients[:-3], np.zeros(3))
    return float(-weights @ np.log(likely) + shrink @ coefficients / 2), gradient + shrink


def _levelled(cases: Sequence[Case], raw: Calibration) -> Calibration:
    """Return coefficients with the maximum-likelihood level, knee and slope."""
    weights = np.array([_ELSEWHERE if case.is_elsewhere else 1.0 for case in cases])
    certainty = np.array([case.certainty for case in cases])
    right = np.empty(len(cases), dtype=bool)
    # utilities of the leading place, of the other hypotheses, and of no correct hypothesis
    own, others, none = np.empty((3, len(cases)))
    for row, case in enumerate(cases):
        lead, odds = _lead(case, raw)
        right[row] = case.right[lead]
        own[row] = np.logaddexp.reduce(odds[SAME_ANSWER.agreeing(case.poses)[lead]])
        every, none[row] = np.logaddexp.reduce(odds), none_right(case.setting, raw)
        others[row] = every + np.log(max(-np.expm1(min(own[row] - every, 0.0)), 1e-300))

    def surprise(level: NDArray[np.float64], knee: float) -> float:
        log_odds = own - np.logaddexp(others, none + level[0])
        log_odds += np.clip(level[1], 0.0, _MOST_SLOPE) * np.maximum(0.0, log_odds - knee)
        likely = np.clip(certainty / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))), 1e-4,
                         1.0 - 1e-4)
        return float(-weights @ np.log(np.where(right, likely, 1.0 - likely)) / weights.sum())

    solutions = [minimize(surprise, [0.0, 0.5], (knee,), method='Nelder-Mead')
                 for knee in _KNEES]
    best = int(np.argmin([solution.fun for solution in solutions]))
    shift, slope = solutions[best].x
    return raw._replace(objects=raw.objects._replace(
        none_right=raw.objects.none_right + float(shift), knee=_KNEES[best],
        slope=float(np.clip(slope, 0.0, _MOST_SLOPE))))


def _lead(case: Case, calibration: Calibration) -> tuple[int, NDArray[np.float64]]:
    """Return the row of the leading hypothesis, and the utility of each hypothesis.

    A hypothesis that contradicts a known vertical cannot lead.
    """
    odds = utilities(case.supports, calibration) - case.handicaps
    is_level = case.handicaps < CALIBRATION.attitude.wrong_mount
    eligible = np.where(is_level, odds, -np.inf) if case.setting.vertical > 0.0 else odds
    return int(np.argmax(eligible)), odds


def outcomes(cases: Sequence[Case], calibration: Calibration = CALIBRATION) -> Judged:
    """Return the confidence (n,) in the leading pose of each case, and whether it is correct."""
    likely, right = [], []
    for case in cases:
        lead, odds = _lead(case, calibration)
        likely.append(case.certainty * confidences(
            odds, case.poses, none_right(case.setting, calibration), calibration)[lead])
        right.append(case.right[lead])
    return np.array(likely), np.array(right, dtype=bool)


def cross_fitted(searched: Sequence[Searched]) -> dict[str, Calibration]:
    """Return the coefficients for each kind, fitted to the other kinds."""
    kinds = dict.fromkeys(result.kind for result in searched)
    return {kind: fit([result.case for result in searched
                       if result.kind in FITTED_KINDS and result.kind != kind]) for kind in kinds}


@dataclass(frozen=True, kw_only=True)
class FittedAnswer(Answer):
    """The leading hypothesis of a case, with its confidence under given coefficients."""

    kind: str
    mode: str
    matching: str


def answers(searched: Sequence[Searched], calibrations: Mapping[str, Calibration]
            ) -> list[FittedAnswer]:
    """Return the answers of searches, with the coefficients of each kind."""
    found = []
    for result in searched:
        (likely,), (right,) = outcomes([result.case], calibrations[result.kind])
        found.append(FittedAnswer(
            kind=result.kind, mode=result.mode, matching=result.matching, accepted=False,
            confidence=float(likely), **({'error_m': 0.0, 'error_deg': 0.0} if right else {})))
    return found


def print_report(searched: Sequence[Searched], calibrations: Mapping[str, Calibration]) -> None:
    """Print precision and recall of each kind, mode and matching, and elsewhere."""
    here = answers([result for result in searched if not result.case.is_elsewhere], calibrations)
    plain = [result for result in here if result.kind in FITTED_KINDS]
    there = answers([result for result in searched if result.case.is_elsewhere], calibrations)
    for name, some, by in (('each kind left out of the fit', here, ['kind']),
                           ('kinds that fit, each left out', plain, ['mode', 'matching']),
                           ('kinds that fit, each left out', plain, []),
                           ('another place, all kinds', there, [])):
        print(f'{name}\n\n{confidence_table(some, by, _THRESHOLDS)}\n')
