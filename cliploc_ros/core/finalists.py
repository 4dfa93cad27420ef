# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The last few of a search: refined, told apart, and each with what it explains."""

from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance import Match
from cliploc_ros.core.ellipsoid import project_ellipsoids
from cliploc_ros.core.refinement import refine
from cliploc_ros.core.scoring import Scene, Workspace, verify
from cliploc_ros.core.search import MAX_DISTINCT, Leaders, Progress, same_place
from cliploc_ros.core.transforms import invert_transform, make_transform
from cliploc_ros.core.uncertainty import box_scatter, pose_covariance, refined_covariance


class Finalist(NamedTuple):
    """One of the best hypotheses at places that differ.

    Parameters
    ----------
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map.
    score : float
        Sum of the IoUs of its inliers.
    iteration : int
        In which it was found, from 1.
    sample : ndarray (s,) of int
        The candidates that it was made from: three, or two where the vertical is known.
    information : ndarray (6, 6) or None
        See refine; None where it was not refined.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    score: float
    iteration: int
    sample: NDArray[np.int64]
    information: NDArray[np.float64] | None = None

    @property
    def map_from_camera(self) -> NDArray[np.float64]:
        """Return the pose (4, 4)."""
        return invert_transform(make_transform(self.rotation, self.translation))


def as_found(leaders: Leaders) -> list[Finalist]:
    """Return the leaders, best first."""
    return [Finalist(leaders.rotations[row], leaders.translations[row],
                     float(leaders.scores[row]), int(leaders.iterations[row]),
                     leaders.samples[row][leaders.samples[row] >= 0])
            for row in leaders.ranked()]


def refined(scene: Scene, leaders: Leaders, vertical: NDArray[np.float64]) -> list[Finalist]:
    """Return the best after refinement, best first; what went to the same place is one.

    Parameters
    ----------
    scene : Scene
    leaders : Leaders
    vertical : ndarray (7,)
        See refine.
    """
    workspace = Workspace.allocate(len(scene.bearings))
    improved = []
    for one in as_found(leaders):
        rotation, translation = one.rotation.copy(), one.translation.copy()
        score, information = refine(scene, rotation, translation, vertical, workspace)
        improved.append(one._replace(rotation=rotation, translation=translation,
                                     score=float(score), information=information))
    distinct: list[Finalist] = []
    for one in sorted(improved, key=lambda one: -one.score):
        if not any(same_place(one.rotation, one.translation, better.rotation, better.translation)
                   for better in distinct):
            distinct.append(one)
    return distinct[:MAX_DISTINCT]


def matches_of(scene: Scene, pose: Finalist) -> tuple[Match, ...]:
    """Return the inliers of a pose."""
    workspace = Workspace.allocate(len(scene.bearings))
    verify(scene, pose.rotation, pose.translation, workspace)
    return tuple(Match(int(row), int(workspace.landmarks[row]), float(workspace.ious[row]))
                 for row in np.nonzero(workspace.landmarks >= 0)[0])


def meetings_of(scene: Scene, pose: Finalist, matches: tuple[Match, ...], progress: Progress,
                samples: NDArray[np.int64] | None) -> int:
    """Return how many of the samples tried hold nothing but a pose's inliers.

    Parameters
    ----------
    scene : Scene
    pose : Finalist
    matches : tuple of Match
        Its inliers.
    progress : Progress
        Of the search.
    samples : ndarray (t, 3) or None
        What was tried; None: all samples of the first candidates, as far as progress reaches.
    """
    landmark_of = np.full(len(scene.bearings), -1, dtype=np.int64)
    for match in matches:
        landmark_of[match.detection] = match.landmark
    is_inlier = landmark_of[scene.pairs[:, 0]] == scene.pairs[:, 1]
    if samples is None:
        return comb(int(is_inlier[:progress.reach].sum()), len(pose.sample))
    tried = samples[:round(progress.coverage * len(samples))]
    return int((is_inlier[tried].all(axis=1) & (tried[:, 0] >= 0)).sum())


def covariance_of(scene: Scene, pose: Finalist, matches: tuple[Match, ...],
                  vertical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a pose: of its refinement, or of its minimal sample.

    Parameters
    ----------
    scene : Scene
    pose : Finalist
    matches : tuple of Match
        Its inliers.
    vertical : ndarray (7,)
        See refine.
    """
    detections = [match.detection for match in matches]
    landmarks = [match.landmark for match in matches]
    map_from_camera = pose.map_from_camera
    outlines = project_ellipsoids(invert_transform(map_from_camera), scene.centers[landmarks],
                                  scene.shapes[landmarks])
    scatter = box_scatter(outlines, scene.box_ellipses[detections])
    if pose.information is not None:
        return refined_covariance(pose.information, scatter)
    sampled = scene.pairs[pose.sample]
    return pose_covariance(map_from_camera, scene.centers[sampled[:, 1]],
                           2.0 * scene.box_ellipses[sampled[:, 0], 2:], scatter, vertical)
