# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best hypotheses of a search, refined and distinct, with their inliers."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import batched, pairwise
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.verification import Rig, scores_of, verify_rig
from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.options import NEVER, Deadline
from cliploc_ros.core.search.frame_search import REFINED, SearchedFrame
from cliploc_ros.core.search.strategies import MAX_DISTINCT

# Maximum number of refined poses that are compared by their support. Of 614 frames of TUM fr3
# (maps of its splits, one image), 16 poses solve 449 within 0.5 m, 8 poses solve 440.
_COMPARED = 16
# Number of poses that are refined between two checks of the time limit.
_REFINED_AT_ONCE = 4
# Maximum number of scorings of a leader on a frame: all 32 leaders of up to five frames, or eight
# leaders of each of ten frames. Ten frames therefore take no longer than five.
_SCORED = 800


@dataclass(frozen=True)
class Match:
    """A detection that a landmark explains."""

    detection: int  #: Row of the detection in its frame
    landmark: int  #: Row of the landmark in the map
    iou: float  #: IoU of the box's ellipse and the outline


class Finalist(NamedTuple):
    """One of the best hypotheses. Refined hypotheses at one place may be different minima."""

    #: (3, 3), (3,): rotation and translation of camera_from_map of the reference frame
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    score: float  #: Sum of the IoUs of its inliers in all frames
    iteration: int  #: Iteration that found it, from 1
    #: (s,): its minimal sample: three candidates, or two if the vertical is known
    sample: NDArray[np.int64]
    #: (6, 6): see Refined; None without refinement
    information: NDArray[np.float64] | None = None

    @property
    def map_from_camera(self) -> NDArray[np.float64]:
        """Return the pose as a transform (4, 4)."""
        return transforms.invert_transform(
            transforms.make_transform(self.rotation, self.translation))


def poses_of(found: Sequence[Finalist]) -> NDArray[np.float64]:
    """Return map_from_camera (m, 4, 4) of each finalist."""
    poses = np.tile(np.eye(4), (len(found), 1, 1))
    backs = np.array([pose.rotation for pose in found]).reshape(-1, 3, 3).transpose(0, 2, 1)
    poses[:, :3, :3] = backs
    poses[:, :3, 3:] = -backs @ np.array([pose.translation for pose in found]).reshape(-1, 3, 1)
    return poses


def find_with_rivals(frames: Sequence[SearchedFrame], rig: Rig, refine: bool, deadline: Deadline
                     ) -> tuple[list[Finalist], NDArray[np.bool_]]:
    """Return the best poses, best first, and which of them use the known vertical.

    The vertical may be wrong. The other poses are therefore the best poses at other places that
    ignore it. See find_finalists for the parameters.
    """
    upright = find_finalists(frames, rig, refine, REFINED, deadline)
    if not upright:
        return [], np.empty(0, dtype=np.bool_)
    tilted = find_finalists([frame._replace(leaders=frame.tilted) for frame in frames], rig,
                            refine, MAX_DISTINCT, deadline)
    same = transforms.SAME_PLACE.agreeing(poses_of(tilted), poses_of(upright)).any(axis=1)
    finalists = upright + [tilted[row] for row in np.nonzero(~same)[0]]
    return finalists, np.arange(len(finalists)) < len(upright)


def find_finalists(frames: Sequence[SearchedFrame], rig: Rig, refine: bool, count: int,
                   deadline: Deadline = NEVER) -> list[Finalist]:
    """Return the best poses among the leaders of all frames, by their scores, best first.

    Without refinement, all poses are at different places. With refinement, there may be several
    poses with different matches at one place. Their support decides between them later. At most
    `count` poses are refined, until a deadline. The other poses
    have lower scores and stay unrefined.
    """
    found = [leader for frame in range(len(frames))
             for leader in _leaders_of(frames, rig, frame)[:_SCORED // len(frames)**2]]
    if len(frames) > 1 and found:
        scores = scores_of(rig, np.stack([pose.rotation for pose in found]),
                           np.stack([pose.translation for pose in found]))
        order = np.argsort(-scores, kind='stable')
        found = [found[row]._replace(score=float(scores[row])) for row in order[
            transforms.SAME_PLACE.distinct(poses_of(found)[order], count)]]
    if not refine:
        return found[:MAX_DISTINCT]
    improved: list[Finalist] = []
    for batch in batched(found, _REFINED_AT_ONCE):
        in_time = not improved or not deadline.is_over
        improved += [pose._replace(**refine_rig(rig, pose.rotation, pose.translation)._asdict())
                     for pose in batch] if in_time else batch
    improved.sort(key=lambda pose: -pose.score)
    # keep the best pose of each minimum
    return [improved[row] for row in transforms.SAME_MINIMUM.distinct(
        poses_of(improved), _COMPARED)]


def _leaders_of(frames: Sequence[SearchedFrame], rig: Rig, frame: int) -> list[Finalist]:
    """Return the leaders of one frame, best first, as poses of the reference camera."""
    leaders = frames[frame].leaders
    camera = rig.cameras[frame]
    back, offset = camera[:, :3].T, camera[:, 3]
    return [Finalist(back @ leaders.rotations[row], back @ (leaders.translations[row] - offset),
                     float(leaders.scores[row]), int(leaders.iterations[row]),
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
    """Return how many of the tried samples consist of inliers of a pose."""
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


def instants_of(frames: Sequence[SearchedFrame]) -> NDArray[np.int64]:
    """Return the number (F,) of each frame's instant, which several cameras may share.

    Frames of one camera with equal stamps count as successive instants.
    """
    seen: Counter[tuple[int, str]] = Counter()
    keys = []
    for observation in (frame.observation for frame in frames):
        source = observation.stamp_ns, observation.camera_name
        keys.append((observation.stamp_ns, seen[source]))
        seen[source] += 1
    order = sorted(set(keys))
    return np.array([order.index(key) for key in keys])
