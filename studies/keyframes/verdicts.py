# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge stored records by the package's verdict, and fit its coefficients for keyframes.

Two logistic models are fitted by maximum likelihood. The first gives the odds of a place from its
points, against a match by chance. It is fitted to images as they are, to darker, blurred and
covered ones, and to other rooms. The second gives the odds that a place is genuine and not a
picture of it, from the signs in all records, given the verdict without them.

Robots see places far more often than pictures of them, so untroubled images have a greater weight.
This weight was chosen as large as possible without accepting more pictures, moved halves and wrong
cameras than before the thorough pass was introduced. Of the pictures on up to 30 % of the image,
fewer than 1 % are accepted in rooms outside the fit.
"""

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.confidence import counted_points
from cliploc_ros.core.acceptance.contenders import join_frames, unrefined
from cliploc_ros.core.acceptance.genuine import Signs
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from studies.keyframes.records import Record, StoredCase, StoredRecognizer, localize
from studies.reports import Answer, chance, fit_logistic, judged
from studies.rooms.rooms import without_boxes

Floats = NDArray[np.float64]

#: The families in which wrong places match by chance.
BY_CHANCE = ('plain', 'image', 'other room', 'classes', 'features')
#: Names in calibration.yaml of the fitted terms.
POINTS = ('none', 'inliers', 'confirmed', 'apart', 'far', 'explained', 'unexplained')
GENUINE = ('none', *Signs._fields)
_UNTROUBLED = ('plain', 'image', 'classes', 'features')
_WEIGHT = 5.5
# Standard deviation of the Gaussian prior of all coefficients but the first, for predictors with a
# standard deviation of 1.
_PRIOR = 3.0
#: Ways to localize; fast: both, without the thorough search of keyframes.
WAYS = ('objects', 'keyframes', 'both', 'fast')


@dataclass(frozen=True, kw_only=True)
class Outcome(Answer):
    """The answer of one way to a query, compared with one of its true poses."""

    site: str
    place: str
    family: str
    case: str
    number: int
    way: str
    truth: int = 0  #: Number of the true pose: 1 is the pose relative to a moved half
    refusal: str


def decide(case: StoredCase, record: Record, way: str) -> Relocalization:
    """Return the package's answer to a record by objects, by keyframes, or by both."""
    searched, keyframes = [look.searched for look in record.looks], _keyframes(case)
    if way == 'keyframes':
        relocalizer = Relocalizer(case.landmark_map, record.options)
        searched = [relocalizer.search(without_boxes(look.observation)) for look in searched]
    return localize(case.landmark_map, record.options, searched, [
        None if way == 'objects' else StoredRecognizer(
            look.seen, keyframes, look.searched.observation.camera, may_be_thorough=way != 'fast')
        for look in record.looks])


@lru_cache(maxsize=1)
def _keyframes(case: StoredCase) -> KeyframeLocalizer:
    return KeyframeLocalizer(case.layer)


def make_judge(ways: Sequence[str] = WAYS) -> Callable[[Path], list[Outcome]]:
    """Return a function that judges the records of a file in the given ways."""
    def judge(path: Path) -> list[Outcome]:
        case: StoredCase = pickle.loads(path.read_bytes())
        return [outcome for record in case.records for way in ways
                for outcome in _outcomes(case, record, way)]
    return judge


def _outcomes(case: StoredCase, record: Record, way: str) -> list[Outcome]:
    found = decide(case, record, way)
    first, *others = [Outcome(
        site=case.place.partition('/')[0], place=case.place, family=case.name.partition(':')[0],
        case=case.name, number=record.number, way=way, truth=number,
        refusal='' if found.accepted else str(found.refusal_kind or way), **judged(found, truth))
        for number, truth in enumerate(record.truths or (None,))]
    return [first, *(replace(other, nees=inf) for other in others)]


@dataclass(frozen=True, kw_only=True)
class Row(Answer):
    """A row of a fit: predictors with a leading 1, and the greatest possible chance."""

    site: str
    family: str
    case: str
    predictors: Floats
    ceiling: float


def place_rows(case: StoredCase) -> list[Row]:
    """Return a row for each place that keyframes recognize."""
    rows, most = [], CALIBRATION.keyframes.most_objects
    for record in case.records:
        look = record.looks[-1]
        joined = join_frames(case.landmark_map, record.options, [look.searched])
        places = [place for seen in look.seen for place in seen.places]
        for place, contender in zip(places, joined.contenders([
                unrefined(place.map_from_camera) for place in places], [True] * len(places)),
                strict=True):
            rows.append(_row(case, record, place.map_from_camera, [
                np.log(counted_points(place)), place.confirmed, min(1.0, place.apart),
                max(0.0, place.apart - 2.0), min(most, contender.support.inliers),
                min(most, contender.support.unexplained)]))
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
    error_m, error_deg = pose_error(pose, record.truths[0]) if record.truths else (inf, inf)
    return Row(site=case.place.partition('/')[0], family=case.name.partition(':')[0],
               case=case.name, predictors=np.array([1.0, *predictors]), ceiling=ceiling,
               accepted=False, confidence=0.0, error_m=error_m, error_deg=error_deg)


def make_rows() -> Callable[[Path], list[tuple[list[Row], list[Row]]]]:
    """Return a function that reads the rows of a file: of places by chance, and of signs."""
    def rows(path: Path) -> list[tuple[list[Row], list[Row]]]:
        case: StoredCase = pickle.loads(path.read_bytes())
        by_chance = case.name.partition(':')[0] in BY_CHANCE
        return [(place_rows(case) if by_chance else [], sign_rows(case))]
    return rows


def fit(rows: Sequence[Row]) -> Floats:
    """Return the coefficients of a logistic model with a ceiling of each row's chance."""
    predictors = np.array([row.predictors for row in rows])
    return fit_logistic(
        predictors, np.array([row.right for row in rows]),
        np.append(0.0, np.full(predictors.shape[1] - 1, _PRIOR ** -2)),
        weights=np.array([_WEIGHT if row.family in _UNTROUBLED else 1.0 for row in rows]),
        ceilings=np.array([row.ceiling for row in rows]))


def left_out(rows: Sequence[Row]) -> list[Row]:
    """Return the rows as judged by coefficients that are fitted to the other sites."""
    others = {site: fit([row for row in rows if row.site != site])
              for site in {row.site for row in rows}}
    chances = [float(row.ceiling * chance(row.predictors, others[row.site])) for row in rows]
    return [replace(row, confidence=likely, accepted=likely >= RelocalizerOptions().min_confidence)
            for row, likely in zip(rows, chances, strict=True)]


def paste(section: str, names: Sequence[str], coefficients: Floats) -> Iterator[str]:
    """Yield the lines of a section of calibration.yaml."""
    yield f'{section}:'
    for name, value in zip(names, coefficients, strict=True):
        yield f'    {name}: {value:.3g}'
