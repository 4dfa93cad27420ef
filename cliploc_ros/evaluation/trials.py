# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Methods run on queries: what each search found, and how far that is from the truth."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import Queries, QueryFrame
from cliploc_ros.errors import DatasetError
from cliploc_ros.evaluation.methods import Method

NS_PER_S = 1e9


@dataclass(frozen=True)
class Query:
    """One question: an observation, and the true answer.

    Parameters
    ----------
    number : int
        Of the frame in its query file, from 0.
    observation : Observation
    map_from_camera : ndarray (4, 4)
        Ground truth.
    neighbours : tuple of Observation
        Frames around it that odometry joins with it.
    """

    number: int
    observation: Observation
    map_from_camera: NDArray[np.float64]
    neighbours: tuple[Observation, ...] = ()


@dataclass(frozen=True)
class Result:
    """What one search found.

    Parameters
    ----------
    method : str
    trial : int
        From 0; its seed is the run's plus this.
    query : int
        Number of the frame in its query file.
    timestamp : float
        Of the image [s].
    boxes : int
        How many detections it has.
    solved, accepted : bool
        Whether a pose was found, and whether it was believed.
    map_from_camera : list of list of float or None
        The best pose; None where none was found, and so the errors.
    error_m, error_deg : float or None
        Its distance from the truth.
    score : float
        Sum of its IoUs.
    confidence : float
        How likely the pose is within 1 m, as the relocalizer has it.
    nees : float or None
        Squared error of the pose in its own covariance, see normalized_square.
    inliers : int
    hypotheses : int
        How many were tried.
    best_iteration : int
        In which one the best was found, from 1.
    coverage : float
        The share of its samples that the search tried.
    reason : str
        Why it was not believed.
    search_ms : float
        Alone of all this, it differs from run to run.
    """

    method: str
    trial: int
    query: int
    timestamp: float
    boxes: int
    solved: bool
    accepted: bool
    map_from_camera: list[list[float]] | None
    error_m: float | None
    error_deg: float | None
    score: float
    confidence: float
    nees: float | None
    inliers: int
    hypotheses: int
    best_iteration: int
    coverage: float
    reason: str
    search_ms: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, for JSON."""
        return asdict(self)


def make_queries(queries: Queries, landmark_map: LandmarkMap, every_frame: bool = False
                 ) -> tuple[Query, ...]:
    """Return the questions of a query file, with similarities in the map's order.

    Parameters
    ----------
    queries : Queries
    landmark_map : LandmarkMap
    every_frame : bool
        Also the neighbouring frames, each as a question of its own.

    Raises
    ------
    DatasetError
        The queries were recorded against another map.
    """
    column = {one: number for number, one in enumerate(queries.landmark_ids)}
    missing = [one for one in landmark_map.landmark_ids if one not in column]
    if missing:
        raise DatasetError(f"the queries say nothing about the map's landmark '{missing[0]}'"
                           f'{f" and {len(missing) - 1} more" if missing[1:] else ""}: they were '
                           'recorded against another map')
    columns = [column[one] for one in landmark_map.landmark_ids]
    fx, fy, cx, cy = queries.intrinsics_fx_fy_cx_cy
    # The image's size is not recorded, and nothing here asks for it.
    camera = Camera(max(1, round(2 * cx)), max(1, round(2 * cy)), fx, fy, cx, cy)
    return tuple(Query(number, _observation(frame, camera, columns), frame.map_from_camera)
                 for number, frame in enumerate(queries.frames) if every_frame or frame.is_main)


def _observation(frame: QueryFrame, camera: Camera, columns: list[int]) -> Observation:
    similarities = np.ascontiguousarray(frame.similarities[:, columns], dtype=np.float32)
    return Observation(camera, Detections(frame.bboxes_xyxy, frame.class_ids, frame.scores),
                       similarities, frame.stamp_ns)


def run_trial(landmark_map: LandmarkMap, method: Method, trial: int, queries: Sequence[Query]
              ) -> list[Result]:
    """Run one trial of a method on some queries.

    Parameters
    ----------
    landmark_map : LandmarkMap
    method : Method
    trial : int
        From 0.
    queries : sequence of Query
    """
    seed = method.options.random_seed + trial
    relocalizer = Relocalizer(landmark_map, replace(method.options, random_seed=seed))
    return [_judge(method.name, trial, query,
                   relocalizer.relocalize([*query.neighbours, query.observation]))
            for query in queries]


def _judge(method: str, trial: int, query: Query, found: Relocalization) -> Result:
    pose = found.map_from_camera
    error_m, error_deg = (None, None) if pose is None else pose_error(pose, query.map_from_camera)
    return Result(
        method=method, trial=trial, query=query.number,
        timestamp=query.observation.stamp_ns / NS_PER_S, boxes=len(query.observation.detections),
        solved=found.solved, accepted=found.accepted,
        map_from_camera=None if pose is None else pose.tolist(),
        error_m=None if error_m is None else float(error_m),
        error_deg=None if error_deg is None else float(error_deg), score=float(found.score),
        confidence=float(found.confidence),
        nees=None if pose is None or found.covariance is None
        else normalized_square(pose, found.covariance, query.map_from_camera),
        inliers=len(found.matches), hypotheses=int(found.tried),
        best_iteration=int(found.best_iteration), coverage=float(found.coverage),
        reason=found.reason, search_ms=float(found.search_ms))
