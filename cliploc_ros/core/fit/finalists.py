# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best hypotheses of a search: refined, distinct, each with its inliers and covariance."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import batched, pairwise
from math import comb, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.covariance import EXACT, POSE_UNKNOWN, refined_covariance
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.verification import Rig, scores_of, verify_rig
from cliploc_ros.core.geometry.transforms import (
    SAME_MINIMUM,
    SAME_PLACE,
    invert_transform,
    make_transform,
)
from cliploc_ros.core.options import used_time_s
from cliploc_ros.core.search.frame_search import REFINED, SearchedFrame
from cliploc_ros.core.search.strategies import MAX_DISTINCT

# The most refined poses that are compared by their support. Of 614 frames of TUM fr3 (maps of its
# splits, one image), 16 solve 449 within 0.5 m, 8 solve 440.
_COMPARED = 16
# Refinement checks the time limit after this many poses.
_REFINED_AT_ONCE = 4
# The most times that a leader of one frame is scored on a frame: all 32 leaders of up to five
# frames, eight leaders of each of ten frames. So ten frames take no longer than five.
_SCORED = 800


@dataclass(frozen=True)
class Match:
    """A detection explained by a landmark: row of the detection, row in the map, IoU."""

    detection: int
    landmark: int
    iou: float


class Finalist(NamedTuple):
    """One of the best hypotheses; refined hypotheses may be different minima at one place."""

    #: (3, 3), (3,): camera_from_map of the reference frame
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    score: float  #: Sum of the IoUs of its inliers in all frames
    iteration: int  #: Iteration that found it, from 1
    frame: int  #: Frame whose search found it
    #: (s,): its minimal sample: three candidates, or two where the vertical is known
    sample: NDArray[np.int64]
    #: (6, 6): see refine_rig; None without refinement
    information: NDArray[np.float64] | None = None

    @property
    def map_from_camera(self) -> NDArray[np.float64]:
        """Return the pose (4, 4)."""
        return invert_transform(make_transform(self.rotation, self.translation))


def poses_of(found: Sequence[Finalist]) -> NDArray[np.float64]:
    """Return the poses (m, 4, 4): map_from_camera of each."""
    return np.array([one.map_from_camera for one in found]).reshape(-1, 4, 4)


def find_with_rivals(frames: Sequence[SearchedFrame], rig: Rig, refine: bool, deadline: float
                     ) -> tuple[list[Finalist], NDArray[np.bool_]]:
    """Return the best poses, best first, and which of them use the known vertical.

    The others are their rivals: the best poses elsewhere that ignore the vertical, which may
    be wrong. See find_finalists for the parameters.
    """
    upright = find_finalists(frames, rig, refine, REFINED, deadline)
    if not upright:
        return [], np.empty(0, dtype=np.bool_)
    tilted = find_finalists([one._replace(leaders=one.tilted) for one in frames], rig, refine,
                            MAX_DISTINCT, deadline)
    same = SAME_PLACE.agreeing(poses_of(tilted), poses_of(upright)).any(axis=1)
    finalists = upright + [tilted[row] for row in np.nonzero(~same)[0]]
    return finalists, np.arange(len(finalists)) < len(upright)


def find_finalists(frames: Sequence[SearchedFrame], rig: Rig, refine: bool, count: int,
                   deadline: float = inf) -> list[Finalist]:
    """Return the best poses among all frames' leaders, by their scores, best first.

    Without refinement no two of them lie at the same place. A place may have several refined
    poses, of different matches: which of them is best, their support tells. At most `count` poses
    are refined, until a deadline of used_time_s [s]; the others, worse ones, stay as found.
    """
    found = [one for frame in range(len(frames))
             for one in _leaders_of(frames, rig, frame)[:_SCORED // len(frames)**2]]
    if len(frames) > 1 and found:
        # The best distinct poses by their scores in all frames, best first.
        scores = scores_of(rig, np.stack([one.rotation for one in found]),
                           np.stack([one.translation for one in found]))
        order = np.argsort(-scores, kind='stable')
        found = [found[row]._replace(score=float(scores[row])) for row in order[
            SAME_PLACE.distinct(poses_of(found)[order], count)]]
    if not refine:
        return found[:MAX_DISTINCT]
    improved: list[Finalist] = []
    for some in batched(found, _REFINED_AT_ONCE):
        in_time = not improved or used_time_s() <= deadline
        improved += [one._replace(**refine_rig(rig, one.rotation, one.translation)._asdict())
                     for one in some] if in_time else some
    improved.sort(key=lambda one: -one.score)
    # one of each minimum
    return [improved[row] for row in SAME_MINIMUM.distinct(poses_of(improved), _COMPARED)]


def _leaders_of(frames: Sequence[SearchedFrame], rig: Rig, frame: int) -> list[Finalist]:
    """Return the leaders of one frame, best first, as poses of the reference."""
    leaders = frames[frame].leaders
    camera = rig.cameras[frame]
    back, offset = camera[:, :3].T, camera[:, 3]
    return [Finalist(back @ leaders.rotations[row], back @ (leaders.translations[row] - offset),
                     float(leaders.scores[row]), int(leaders.iterations[row]), frame,
                     leaders.samples[row][leaders.samples[row] >= 0])
            for row in leaders.ranked()]


def matches_of(rig: Rig, pose: Finalist) -> list[tuple[Match, ...]]:
    """Return the inliers of a pose in each frame."""
    found = verify_rig(rig, pose.rotation, pose.translation)
    return [tuple(Match(int(row - first), int(found.landmarks[row]), float(found.ious[row]))
                  for row in range(first, last) if found.landmarks[row] >= 0)
            for first, last in pairwise(rig.starts.boxes)]


def meetings_of(frames: Sequence[SearchedFrame], pose: Finalist,
                matches: Sequence[Sequence[Match]]) -> int:
    """Return how many of the samples tried hold only inliers of a pose."""
    meetings = 0
    for frame, found in zip(frames, matches, strict=True):
        scene, progress = frame.scene, frame.progress
        landmark_of = np.full(len(scene.bearings), -1, dtype=np.int64)
        for match in found:
            landmark_of[match.detection] = match.landmark
        is_inlier = landmark_of[scene.pairs[:, 0]] == scene.pairs[:, 1]
        if frame.samples is None:
            meetings += comb(int(is_inlier[:progress.reach].sum()), len(pose.sample))
        else:
            tried = frame.samples[:round(progress.coverage * len(frame.samples))]
            meetings += int((is_inlier[tried].all(axis=1) & (tried[:, 0] >= 0)).sum())
    return meetings


def covariance_of(frames: Sequence[SearchedFrame], rig: Rig, pose: Finalist,
                  shared: NDArray[np.float64] | None = None,
                  mount_deviation: tuple[float, float] = (0.0, 0.0),
                  camera_deviations: NDArray[np.float64] = EXACT) -> NDArray[np.float64]:
    """Return the covariance of a pose by its inliers.

    Parameters
    ----------
    shared, mount_deviation, camera_deviations
        See refined_covariance.
    """
    if pose.information is not None and not pose.information.any():
        return POSE_UNKNOWN
    return refined_covariance(rig, pose.rotation, pose.translation, _instants(frames), shared,
                              mount_deviation=mount_deviation,
                              camera_deviations=camera_deviations)


def _instants(frames: Sequence[SearchedFrame]) -> NDArray[np.int64]:
    """Return the number of each frame's instant (F,): several cameras may see the same one.

    Frames of one camera at one stamp follow each other.
    """
    seen: Counter[tuple[int, str]] = Counter()
    keys = []
    for one in (frame.observation for frame in frames):
        keys.append((one.stamp_ns, seen[one.stamp_ns, one.camera_name]))
        seen[one.stamp_ns, one.camera_name] += 1
    order = sorted(set(keys))
    return np.array([order.index(key) for key in keys])
