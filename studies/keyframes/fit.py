# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit to stored records what points of keyframes say, and the signs of pictures.

Both are logistic models, fitted by maximum likelihood. First the odds of a place by its points,
against a place by chance: images as they are, or darker, blurred and covered, and other rooms.
Then the signs that a place is there, in all records, given what the verdict says without them.

Robots see places far more often than pictures of them, so untroubled images weigh more than there
are. Their weight is a choice: so large that of the pictures on up to 30 % of the image one of a
hundred is accepted, in rooms that did not fit.
"""

import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.contenders import contenders_of, join_frames, unrefined
from cliploc_ros.core.acceptance.genuine import Signs
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.options import RelocalizerOptions
from studies.keyframes.judge import decide
from studies.keyframes.records import Record, StoredCase

Floats = NDArray[np.float64]

#: The families in which a wrong place is wrong by chance.
BY_CHANCE = ('plain', 'image', 'other room', 'classes', 'features')
#: The terms that are fitted, as calibration.yaml calls them.
POINTS = ('none', 'inliers', 'confirmed', 'explained', 'unexplained')
GENUINE = ('none', *Signs._fields)
_UNTROUBLED = ('plain', 'image', 'classes', 'features')
_WEIGHT = 4.0
# Deviations of the Gaussian prior of all coefficients but the first, for signs of deviation 1.
_PRIOR = 3.0


class Row(NamedTuple):
    """A place: predictors with a leading 1, the most that its chance can be, and the truth."""

    site: str
    family: str
    case: str
    predictors: Floats
    ceiling: float
    is_right: bool


def place_rows(case: StoredCase) -> list[Row]:
    """Return a row for each place that keyframes recognize."""
    rows, most = [], CALIBRATION.keyframes.most_objects
    for record in case.records:
        look = record.looks[-1]
        joined = join_frames(case.landmark_map, record.options, [look.searched])
        places = look.seen.places
        for place, one in zip(places, contenders_of(joined, [
                unrefined(place.map_from_camera) for place in places], [True] * len(places)),
                strict=True):
            rows.append(_row(case, record, place.map_from_camera, [
                np.log(max(1, place.inliers)), place.confirmed,
                min(most, one.support.inliers), min(most, one.support.unexplained)]))
    return rows


def sign_rows(case: StoredCase) -> list[Row]:
    """Return a row for each answer that keyframes propose."""
    rows = []
    for record in case.records:
        found = decide(case, record, 'both')
        if found.map_from_camera is None or found.evidence is None or found.evidence.signs is None:
            continue
        rows.append(_row(case, record, found.map_from_camera, found.evidence.signs,
                         found.evidence.confidence / max(found.evidence.genuine, 1e-12)))
    return rows


def _row(case: StoredCase, record: Record, pose: Floats, predictors: Sequence[float],
         ceiling: float = 1.0) -> Row:
    errors = [pose_error(pose, truth)[0] for truth in record.truths[:1]]
    return Row(case.place.partition('/')[0], case.name.partition(':')[0], case.name,
               np.array([1.0, *predictors]), ceiling, min(errors, default=np.inf) < RIGHT_M)


def make_rows() -> Callable[[Path], tuple[list[Row], list[Row]]]:
    """Return what reads the rows of a file: of places by chance, and of signs."""
    def rows(path: Path) -> tuple[list[Row], list[Row]]:
        case: StoredCase = pickle.loads(path.read_bytes())
        by_chance = case.name.partition(':')[0] in BY_CHANCE
        return place_rows(case) if by_chance else [], sign_rows(case)
    return rows


def fit(rows: Sequence[Row]) -> Floats:
    """Return the coefficients of a logistic model whose chance counts below each row's ceiling."""
    predictors, ceilings = (np.array([getattr(one, name) for one in rows])
                            for name in ('predictors', 'ceiling'))
    right = np.array([one.is_right for one in rows])
    weights = np.array([_WEIGHT if one.family in _UNTROUBLED else 1.0 for one in rows])
    scales = np.append(1.0, np.maximum(predictors[:, 1:].std(axis=0), 1e-6))

    def loss(scaled: Floats) -> tuple[float, Floats]:
        logistic = chance(predictors, scaled / scales)
        chances = np.clip(ceilings * logistic, 1e-9, 1.0 - 1e-9)
        slopes = (1.0 - logistic) * np.where(right, 1.0, -chances / (1.0 - chances))
        shrunk = np.append(0.0, scaled[1:]) / _PRIOR ** 2
        return (float(0.5 * shrunk @ scaled - weights @ np.log(
            np.where(right, chances, 1.0 - chances))),
            shrunk - (weights * slopes) @ predictors / scales)
    found = minimize(loss, np.zeros(len(scales)), jac=True, method='BFGS')
    return np.asarray(found.x / scales)


def chance(predictors: Floats, coefficients: Floats) -> Floats:
    """Return the logistic chance (n,) of predictors (n, k)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(predictors @ coefficients, -50.0, 50.0))))


def left_out(rows: Sequence[Row]) -> Floats:
    """Return each row's chance by the coefficients that the other sites fit."""
    found = np.empty(len(rows))
    for site in {one.site for one in rows}:
        its = [number for number, one in enumerate(rows) if one.site == site]
        coefficients = fit([one for one in rows if one.site != site])
        found[its] = chance(np.array([rows[number].predictors for number in its]), coefficients) \
            * [rows[number].ceiling for number in its]
    return found


def report(rows: Sequence[Row], chances: Floats) -> Iterator[str]:
    """Yield a line for each case: right and wrong places, and how many of them are sure enough."""
    for case in dict.fromkeys(one.case for one in rows):
        its = np.array([one.case == case for one in rows])
        right = np.array([one.is_right for one in rows])[its]
        sure = chances[its] >= RelocalizerOptions().min_confidence
        yield (f'{case:36} {right.sum():4} right, {(sure & right).sum():4} of them sure, '
               f'{(~right).sum():4} wrong, {(sure & ~right).sum():4} of them sure')


def paste(section: str, names: Sequence[str], coefficients: Floats) -> Iterator[str]:
    """Yield what calibration.yaml is to say."""
    yield f'{section}:'
    for name, value in zip(names, coefficients, strict=True):
        yield f'    {name}: {value:.3g}'
