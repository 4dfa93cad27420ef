# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robots that look again and again, with the session that the relocalizer node uses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.verdict import refusal
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.sensors import with_neighbours
from cliploc_ros.offline.evaluation.trials import PosedQuery
from studies.acceptance.places import (
    STEP_DEG,
    STEP_M,
    VERTICAL_DEG,
    Place,
    Recording,
    Simulated,
)
from studies.acceptance.troubles import of_rows
from studies.reports import BINS, Judged, interval, mean, table
from studies.worlds.cameras import GROUP_SIZE
from studies.wrong_sensors import with_mount_error

LOOKS = 20
_PERIOD_NS = 100_000_000
# What a detector does to the same view another time. Guesses.
_MISSED_SHARE = 0.2
_SHIFT_SHARE = 0.02  # of the box's sides, standard deviation
_WINDOW_S = 1e6


@dataclass(frozen=True)
class Retries:
    """The looks of one robot, as arrays (LOOKS,): accepted without the others or after them."""

    alone: NDArray[np.bool_]
    accepted: NDArray[np.bool_]
    errors_m: NDArray[np.float64]  # infinite where no pose was found

    @property
    def first_error_m(self) -> float:
        """Return the error of the first accepted pose, which ends the retries; NaN without."""
        return float(self.errors_m[np.argmax(self.accepted)]) if self.accepted.any() else np.nan


def retry(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], options: RelocalizerOptions,
          seed: int = 0) -> Iterator[Retries]:
    """Let a robot look 20 times at each query; each look misses some boxes and shifts others."""
    relocalizer, rng = Relocalizer(landmark_map, options), np.random.default_rng(seed)
    for query in queries:
        session = Localizer(relocalizer)
        alone, accepted, errors_m = [], [], []
        for number in range(LOOKS):
            look = replace(_flickering(query.observation, rng), odom_from_camera=np.eye(4),
                           stamp_ns=(number + 1) * _PERIOD_NS)
            found = session.answer(Query((look,)))
            accepted.append(found.accepted)
            alone.append(found.evidence is not None and not refusal(
                replace(found.evidence, earlier=()), options))
            errors_m.append(_error_m(found.map_from_camera, query))
        yield Retries(np.array(alone), np.array(accepted), np.array(errors_m))


def _flickering(observation: Observation, rng: np.random.Generator) -> Observation:
    """Return an observation without some of its boxes; the others are shifted."""
    detections = observation.detections
    rows = np.nonzero(rng.random(len(detections)) > _MISSED_SHARE)[0]
    sides = np.tile(np.diff(detections.bboxes_xyxy.reshape(-1, 2, 2), axis=1)[:, 0], 2)
    shifted = detections.bboxes_xyxy + _SHIFT_SHARE * sides * rng.normal(size=sides.shape)
    return of_rows(replace(observation, detections=replace(detections, bboxes_xyxy=shifted)),
                   rows)


def _error_m(pose: NDArray[np.float64] | None, query: PosedQuery) -> float:
    return np.inf if pose is None else float(pose_error(pose, query.map_from_camera)[0])


def retries_row(name: str, min_confidence: float, robots: Sequence[Retries]) -> list[str]:
    """Return a row of the table of retries."""
    counts = [sum(bool(one.accepted[0]) for one in robots),
              sum(bool(one.alone.any()) for one in robots),
              sum(bool(one.accepted.any()) for one in robots)]
    wrong = sum(one.first_error_m > RIGHT_M for one in robots)
    return [name, f'{min_confidence:g}',
            *(f'{one} of {len(robots)} ({interval(one, len(robots))})' for one in counts),
            f'{wrong}']


class Answer(NamedTuple):
    """The answer after some images of a group; the error is infinite without a pose."""

    images: int
    confidence: float
    error_m: float
    accepted: bool


@dataclass(frozen=True)
class MakeWalker:
    """Makes the function that answers at a place after one image, two and so on."""

    vertical: bool
    options: RelocalizerOptions

    def __call__(self) -> Callable[[Recording | Simulated], list[list[Answer]]]:
        """Return the function."""
        return lambda place: list(grow(place.load(), self.options, place.seed, self.vertical))


def grow(place: Place, options: RelocalizerOptions, seed: int, vertical: bool
         ) -> Iterator[list[Answer]]:
    """Yield the answers to each group of images, with a vertical that is off by a degree."""
    queries = place.frames
    if vertical:
        queries = with_mount_error(queries, place.groups, VERTICAL_DEG, seed)
    queries = with_neighbours(queries, place.groups, STEP_M, STEP_DEG, seed)
    landmark_map = place.landmark_map
    relocalizer = Relocalizer(landmark_map, replace(
        options, k=min(options.k, len(landmark_map)), crops='all'))
    for group in dict.fromkeys(place.groups):
        session = Localizer(relocalizer)
        answers: list[Answer] = []
        for query in sorted((one for one, its in zip(queries, place.groups, strict=True)
                             if its == group), key=lambda one: one.observation.stamp_ns):
            found = session.answer(Query((query.observation,), limit=GROUP_SIZE,
                                         length_s=_WINDOW_S))
            answers.append(Answer(len(answers) + 1, found.confidence,
                                  _error_m(found.map_from_camera, query), found.accepted))
        yield answers


def judged_after(groups: Sequence[Sequence[Answer]]) -> dict[int, Judged]:
    """Return confidences, and whether right, after each number of images."""
    found = {}
    for images in range(1, 1 + max(map(len, groups), default=0)):
        answers = [one[images - 1] for one in groups if len(one) >= GROUP_SIZE]
        found[images] = (np.array([one.confidence for one in answers]),
                         np.array([one.error_m < RIGHT_M for one in answers], dtype=np.bool_))
    return found


def growth_tables(groups: Sequence[Sequence[Answer]]) -> str:
    """Return the growth and the reliability after each number of images, as Markdown."""
    judged = judged_after(groups)
    growth = []
    for images, (confidence, right) in judged.items():
        accepted = np.array([one[images - 1].accepted for one in groups
                             if len(one) >= GROUP_SIZE], dtype=np.bool_)
        grew = ''
        if images > 1:
            before, was_right = judged[images - 1]
            grew = mean((confidence > before)[was_right & right])
        growth.append([images, f'{right.sum()} of {len(right)}', mean(confidence),
                       mean(confidence[right]), mean(confidence[~right]), grew,
                       f'{accepted.sum()}, {(accepted & ~right).sum()}', mean(accepted[right])])
    reliability = []
    for low, high in pairwise(BINS):
        cells = [f'{low:.2f} to {high:.2f}']
        for confidence, right in judged.values():
            own = (confidence >= low) & ((confidence < high) | (high == 1.0))
            count, total = int(right[own].sum()), int(own.sum())
            cells.append(f'{count} of {total} ({interval(count, total)}; mean '
                         f'{confidence[own].mean():.2f})' if total else '')
        reliability.append(cells)
    reliability.append(['all: expected, right', *(
        f'{confidence.sum():.0f}, {right.sum()}' for confidence, right in judged.values())])
    return '\n\n'.join([
        table(['images', 'poses within 1 m', 'mean confidence', 'of the right', 'of the wrong',
               'grew, of those right twice', 'accepted, wrong', 'recall'], growth),
        table(['confidence', *(f'{images} image{"s"[:images > 1]}' for images in judged)],
              reliability)])
