# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge stored records by the package's verdict."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf
from pathlib import Path

from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from studies.keyframes.records import Record, StoredCase, StoredRecognizer, localize
from studies.reports import Answer, judged
from studies.rooms.rooms import without_boxes

WAYS = ('objects', 'keyframes', 'both')


@dataclass(frozen=True, kw_only=True)
class Outcome(Answer):
    """One way's answer to a query, by one of its true poses."""

    site: str
    place: str
    family: str
    case: str
    number: int
    way: str
    truth: int = 0  #: Which of the true poses: 1 is that by a moved half
    refusal: str


def decide(case: StoredCase, record: Record, way: str) -> Relocalization:
    """Return the package's answer to a record by objects, by keyframes, or by both."""
    searched, keyframes = [one.searched for one in record.looks], _keyframes(case)
    if way == 'keyframes':
        relocalizer = Relocalizer(case.landmark_map, record.options)
        searched = [relocalizer.search(without_boxes(one.observation)) for one in searched]
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
        return [one for record in case.records for way in ways
                for one in _outcomes(case, record, way)]
    return judge


def _outcomes(case: StoredCase, record: Record, way: str) -> list[Outcome]:
    found = decide(case, record, way)
    first, *others = [Outcome(
        site=case.place.partition('/')[0], place=case.place, family=case.name.partition(':')[0],
        case=case.name, number=record.number, way=way, truth=number,
        refusal='' if found.accepted else str(found.refusal_kind or way), **judged(found, truth))
        for number, truth in enumerate(record.truths or (None,))]
    return [first, *(replace(one, nees=inf) for one in others)]
