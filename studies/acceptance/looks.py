# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robots that look again and again, with the session that the relocalizer node uses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

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
from cliploc_ros.offline.evaluation.trials import PosedQuery
from studies.acceptance.troubles import of_rows
from studies.reports import interval

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
