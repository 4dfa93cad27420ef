# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge stored records by the package's verdict: tables and the figure of reliability."""

import pickle
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.offline.evaluation.figures import within_ellipsoid
from studies.keyframes.records import Record, StoredCase, StoredRecognizer, localize
from studies.reports import SUCCESS_M, Judged, errors_of, grouped, interval

WAYS = ('objects', 'keyframes', 'both')
_NO_BOXES = Detections(np.empty((0, 4)), (), np.empty(0))


class Outcome(NamedTuple):
    """One way's answer to a query, whose errors from each true pose are infinite without one."""

    site: str
    place: str
    family: str
    case: str
    number: int
    way: str
    errors_m: tuple[float, ...]
    accepted: bool
    confidence: float
    nees: float
    refusal: str
    reason: str
    source: str


def decide(case: StoredCase, record: Record, way: str) -> Relocalization:
    """Return the package's answer to a record by objects, by keyframes, or by both."""
    searched, keyframes = [one.searched for one in record.looks], _keyframes(case)
    if way == 'keyframes':
        relocalizer = Relocalizer(case.landmark_map, record.options)
        searched = [relocalizer.search(replace(one.observation, detections=_NO_BOXES))
                    for one in searched]
    return localize(case.landmark_map, record.options, searched, [
        None if way == 'objects' else StoredRecognizer(
            one.seen, keyframes, one.searched.observation.camera) for one in record.looks])


@lru_cache(maxsize=1)
def _keyframes(case: StoredCase) -> KeyframeLocalizer:
    return KeyframeLocalizer(case.layer)


def make_judge(ways: Sequence[str] = WAYS) -> Callable[[Path], list[Outcome]]:
    """Return what judges the records of a file in some ways."""
    def judge(path: Path) -> list[Outcome]:
        case: StoredCase = pickle.loads(path.read_bytes())
        return [_outcome(case, record, way, decide(case, record, way))
                for record in case.records for way in ways]
    return judge


def _outcome(case: StoredCase, record: Record, way: str, found: Relocalization) -> Outcome:
    errors = [errors_of(found, truth) for truth in record.truths] or [(np.inf,) * 3]
    return Outcome(
        case.place.partition('/')[0], case.place, case.name.partition(':')[0], case.name,
        record.number, way, tuple(error_m for error_m, *_ in errors), found.accepted,
        float(found.confidence), float(errors[0][2]),
        '' if found.accepted else str(found.refusal_kind or way), found.reason, found.source)


def table(outcomes: Iterable[Outcome], by: Sequence[str]) -> list[str]:
    """Return a line for each group of outcomes, which fields make, and each way."""
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for one in outcomes:
        name = '  '.join(getattr(one, field) for field in by)
        groups.setdefault((name, one.way), []).append(one)
        if len(one.errors_m) > 1:
            moved = one._replace(errors_m=one.errors_m[1:], nees=np.inf)
            groups.setdefault((f'{name} (by the moved half)', one.way), []).append(moved)
    width = max([4, *(len(name) for name, _ in groups)])
    return [f'{"case":{width}}  way        queries   .1  .25   .5  1 m  accepted  recall  in 95 %'
            '  false  95 % of queries  refused',
            *(f'{name:{width}}  {way:9}  {_figures(found)}'
              for (name, way), found in groups.items())]


def _figures(outcomes: Sequence[Outcome]) -> str:
    errors = np.array([one.errors_m[0] for one in outcomes])
    accepted = np.array([one.accepted for one in outcomes])
    nees = np.array([one.nees for one in outcomes])
    right, judged = errors < RIGHT_M, accepted & np.isfinite(nees)
    shares = ' '.join(f'{np.mean(errors < limit):4.2f}' for limit in SUCCESS_M)
    recall = f'{accepted[right].mean():.2f}' if right.any() else '-'
    inside = f'{within_ellipsoid(nees[judged]):.2f}' if judged.any() else '-'
    false = int((accepted & ~right).sum())
    kinds = Counter(one.refusal for one in outcomes if one.refusal).most_common()
    return (f'{len(errors):7}  {shares}  {accepted.sum():8}  {recall:>6}  {inside:>7}  {false:5}  '
            f'{interval(false, len(errors), 3)}  '
            + ', '.join(f'{count} {kind}' for kind, count in kinds))


def confidences_by_way(outcomes: Sequence[Outcome]) -> dict[str, Judged]:
    """Return the confidence above 0 of each way's answers, and if they are right."""
    groups = grouped([one for one in outcomes if one.confidence > 0.0], ['way'])
    return {way: (np.array([one.confidence for one in its]),
                  np.array([one.errors_m[0] < RIGHT_M for one in its]))
            for (way,), its in sorted(groups.items(), key=lambda group: WAYS.index(group[0][0]))}
