# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Searches over places, modes, matchings and troubles, and retries of a standing robot."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import ceil, inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.verdict import refusal
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.methods import AUTO, Method
from cliploc_ros.offline.evaluation.trials import run_trial
from cliploc_ros.offline.posed_query import PosedQuery
from studies.acceptance.places import SEED, AnyPlace, Place
from studies.acceptance.troubles import FAMILIES, PRIORS, TROUBLES, flickering
from studies.reports import Answer, interval, judged

#: More queries than any place has.
MANY = 1_000_000
#: Looks of one localizer before it can detect a wrong camera.
EARLY_LOOKS = 5
#: Looks of a robot that does not move.
LOOKS = 20
_PERIOD_NS = 100_000_000
_CHANGES = TROUBLES | PRIORS | FAMILIES


class Task(NamedTuple):
    """All queries of a place in a mode, with a trouble."""

    place: AnyPlace
    mode: str
    options: RelocalizerOptions = RelocalizerOptions()
    trouble: str = 'none'
    level: float = 0.0
    seed: int = SEED  # of the sensors and of the trouble
    most: int = MANY  # greatest number of queries, evenly spread
    in_order: bool = False  # one localizer gets all frames


@dataclass(frozen=True, kw_only=True)
class Outcome(Answer):
    """The answer to one request of a task."""

    place: str
    mode: str
    matching: str
    trouble: str
    level: float
    looks: str = 'alone'  # or the part of one localizer's looks: 'first five' or 'later'


def make_search() -> Callable[[Task], list[Outcome]]:
    """Return the function that searches, for a worker."""
    return search


def search(task: Task) -> list[Outcome]:
    """Return the outcomes of all queries of a place; none if it does not support the mode.

    Unless they are in order, queries are independent questions, each to a new localizer.
    """
    place = _loaded(task.place)
    if task.mode not in place.modes:
        return []
    trouble = _CHANGES[task.trouble]
    asked = place._replace(is_main=[True] * len(place.frames)) if task.in_order else place
    queries = asked.ask(task.mode, task.seed)
    landmark_map, changed = trouble.change(
        place.landmark_map, queries[::max(1, ceil(len(queries) / task.most))], task.level,
        np.random.default_rng(task.seed))
    options = place.options(task.mode, task.options)
    options = replace(options, k=min(options.k, len(landmark_map)))
    outcome = partial(Outcome, place=task.place.name, mode=task.mode, matching=options.matching,
                      trouble=task.trouble, level=task.level)
    if task.in_order:
        return [outcome(looks='first five' if number < EARLY_LOOKS else 'later', **fields)
                for number, (fields, *_) in enumerate(look_on(
                    Relocalizer(landmark_map, options), changed))]
    return [outcome(accepted=result.accepted, confidence=result.confidence,
                    error_m=inf if result.error_m is None else result.error_m,
                    error_deg=inf if result.error_deg is None else result.error_deg,
                    nees=inf if result.nees is None else result.nees)
            for query in changed
            for result in run_trial(landmark_map, Method(AUTO, options), 0, [query])]


def look_on(relocalizer: Relocalizer, queries: Iterable[PosedQuery], is_one: bool = True
            ) -> Iterator[tuple[dict[str, Any], bool, bool]]:
    """Yield the fields of each answer, and whether the camera is called wrong, and looked at.

    One localizer gets all queries in order, without odometry, or each query a new localizer.
    """
    localizer = Localizer(relocalizer)
    for query in queries:
        if not is_one:
            localizer = Localizer(relocalizer)
        found = localizer.answer(Query((query.observation,), run=None))
        yield (judged(found, query.map_from_camera), bool(localizer.cameras.faults),
               bool(found.cameras))


@lru_cache(maxsize=256)
def _loaded(place: AnyPlace) -> Place:
    return place.load()


def tasks_of(places: Sequence[AnyPlace], options: RelocalizerOptions,
             names: Sequence[str], seed: int = SEED) -> list[Task]:
    """Return a task for each level, mode and place of the named troubles."""
    return [Task(place, mode, options, name, level, seed) for name in names
            for level in _CHANGES[name].levels for place in places
            for mode in _CHANGES[name].modes]


@dataclass(frozen=True)
class Retries:
    """The looks of one robot, as arrays (LOOKS,): accepted alone, or with the earlier looks."""

    alone: NDArray[np.bool_]
    accepted: NDArray[np.bool_]
    errors_m: NDArray[np.float64]  # infinite where no pose was found

    @property
    def first_error_m(self) -> float:
        """Return the error of the first accepted pose, which ends the retries; NaN if none."""
        return float(self.errors_m[np.argmax(self.accepted)]) if self.accepted.any() else np.nan


def retry(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], options: RelocalizerOptions,
          seed: int = 0) -> Iterator[Retries]:
    """Let a robot look 20 times at each query; each look misses some boxes and shifts others."""
    relocalizer, rng = Relocalizer(landmark_map, options), np.random.default_rng(seed)
    for query in queries:
        session = Localizer(relocalizer)
        alone, accepted, errors_m = [], [], []
        for number in range(LOOKS):
            look = replace(flickering(query.observation, rng), odom_from_camera=np.eye(4),
                           stamp_ns=(number + 1) * _PERIOD_NS)
            found = session.answer(Query((look,)))
            accepted.append(found.accepted)
            alone.append(found.evidence is not None and not refusal(
                replace(found.evidence, earlier=()), options))
            errors_m.append(judged(found, query.map_from_camera).get('error_m', inf))
        yield Retries(np.array(alone), np.array(accepted), np.array(errors_m))


def retries_row(name: str, min_confidence: float, robots: Sequence[Retries]) -> list[str]:
    """Return a row of the table of retries."""
    counts = [sum(bool(robot.accepted[0]) for robot in robots),
              sum(bool(robot.alone.any()) for robot in robots),
              sum(bool(robot.accepted.any()) for robot in robots)]
    wrong = sum(robot.first_error_m > RIGHT_M for robot in robots)
    return [name, f'{min_confidence:g}',
            *(f'{count} of {len(robots)} ({interval(count, len(robots))})' for count in counts),
            f'{wrong}']
