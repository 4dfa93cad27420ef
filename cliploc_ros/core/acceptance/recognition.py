# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The confidence of a pose from keyframes, and the decision to accept or refuse it.

Inliers count for it, as do the share of the image that they confirm and the objects that the map
explains there. A pose elsewhere with inliers of its own counts against it, and so do objects that
the map does not explain.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.agreement import RIGHT_M
from cliploc_ros.core.acceptance.confidence import MOST_CONFIDENCE
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.localization import Recognition
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions

# Log odds that the pose of keyframes is right: of the logarithm of its inliers, of the share of
# the image that is confirmed, of each detected object that the map explains there and of each
# that it does not. Rounded by hand on the kitchen's halves and on rooms that are not in the map,
# see cliploc_ros.evaluation.keyframes.
_INLIERS, _CONFIRMED, _EXPLAINED, _UNEXPLAINED, _NONE = 5.0, 6.0, 0.7, -0.7, -15.3
# Of the inliers, so many are lost for each that a pose elsewhere has.
_RIVAL_COUNTS = 3.0
# Features alone are accepted only where they confirm so much of the image.
_LEAST_CONFIRMED, _LEAST_INLIERS = 0.3, 20
# As many points elsewhere contradict a pose; of 231 right poses of the kitchen, none had more
# than 19. So does a share of the image that is much less than its inliers let expect, as where
# they lie on a poster: from a few inliers up to many.
_MOST_RIVAL = 20
_LEAST_OF_EXPECTED, _MORE_OF_EXPECTED, _MANY_INLIERS = 0.6, 0.32, 300
# So does a pose that is so many standard deviations off the known vertical. A guess: one right
# pose of 270,000 is, if the vertical is right.
_MOST_TILT_ERROR = 5.0
# Detected objects of the map's classes contradict a pose that explains so few of them.
_MOST_UNEXPLAINED, _LEAST_EXPLAINED = 4, 0.25
# A detection is explained by a landmark of its class whose outline overlaps it so much.
_EXPLAINS_IOU = 0.2
# Points along each side of the image that tell how far it reaches.
_STEPS = 33


class ObjectsThere(NamedTuple):
    """How many detected objects of the map's classes a pose explains, and how many not."""

    explained: int
    unexplained: int


#: An image without objects, or one whose objects do not count.
NO_OBJECTS = ObjectsThere(0, 0)


def objects_there(landmark_map: LandmarkMap, observation: Observation,
                  map_from_camera: NDArray[np.float64]) -> ObjectsThere:
    """Return how the detections of an image agree with the landmarks around a pose.

    Parameters
    ----------
    landmark_map : LandmarkMap
    observation : Observation
        Of the image.
    map_from_camera : ndarray (4, 4)
    """
    classes = landmark_map.classes.classes_of(observation.detections.class_ids)
    known = landmark_map.classes.are_own(classes)
    boxes = observation.camera.normalize_bboxes(observation.detections.bboxes_xyxy[known])
    outlines = project_ellipsoids(invert_transform(map_from_camera), landmark_map.centers,
                                  landmark_map.shapes)
    expected = _inside(ellipse_bboxes(outlines), observation)
    overlaps = _overlaps(_inside(boxes, observation), expected)
    same = landmark_map.classes.of_landmarks == classes[known][:, None]
    explained = int(((overlaps > _EXPLAINS_IOU) & same).any(axis=1).sum())
    return ObjectsThere(explained, len(boxes) - explained)


def chance_recognized(seen: Recognition, there: ObjectsThere) -> float:
    """Return the probability that the first place of keyframes is within 1 m of the truth."""
    first = seen.places[0]
    inliers = max(1.0, first.inliers - _RIVAL_COUNTS * seen.rival)
    odds = (_NONE + _INLIERS * math.log(inliers) + _CONFIRMED * first.confirmed
            + _EXPLAINED * there.explained + _UNEXPLAINED * there.unexplained)
    right = 1.0 / (1.0 + math.exp(-min(odds, 50.0)))
    if _inconsistent(seen, there):
        right = min(right, 0.5)
    return min(MOST_CONFIDENCE, right) * share_within(RIGHT_M, first.covariance)


def _inconsistent(seen: Recognition, there: ObjectsThere) -> str:
    """Return what in the image contradicts a pose of keyframes; empty where nothing does."""
    first = seen.places[0]
    if seen.rival >= _MOST_RIVAL:
        return f'{first.inliers} points agree, but {seen.rival} on another place'
    least = _LEAST_OF_EXPECTED + _MORE_OF_EXPECTED * min(1.0, first.inliers / _MANY_INLIERS)
    if first.confirmed < least * first.expected:
        return (f'{first.inliers} points agree, but only in {first.confirmed:.0%} of the image; '
                'has something been moved?')
    if first.tilt_error > _MOST_TILT_ERROR:
        return (f'the pose is {first.tilt_error:.1f} standard deviations off against the known '
                f'vertical > {_MOST_TILT_ERROR:g}; is the camera mount right?')
    known = there.explained + there.unexplained
    if there.unexplained >= _MOST_UNEXPLAINED and there.explained < _LEAST_EXPLAINED * known:
        return f'{there.unexplained} of {known} objects are not where the pose expects them'
    return ''


def refusal_of(seen: Recognition, there: ObjectsThere, chance: float,
               options: RelocalizerOptions) -> str:
    """Return why the pose of keyframes is refused; empty if it is accepted."""
    first = seen.places[0]
    if first.inliers < _LEAST_INLIERS:
        return f'{first.inliers} points agree < {_LEAST_INLIERS}'
    if first.confirmed < _LEAST_CONFIRMED:
        return (f'{first.confirmed:.0%} of the image shows what it should < '
                f'{_LEAST_CONFIRMED:.0%}')
    if inconsistent := _inconsistent(seen, there):
        return inconsistent
    if chance < options.min_confidence:
        rival = f', {seen.rival} elsewhere' if seen.rival else ''
        return (f'confidence {math.floor(chance * 100) / 100:.2f} < {options.min_confidence:g}, '
                f'{first.inliers} points agree{rival}')
    return ''


def _inside(boxes: NDArray[np.float64], observation: Observation) -> NDArray[np.float64]:
    """Return boxes (n, 4) of the plane z = 1, cut at the border of the image."""
    low, high = _extent(observation.camera)
    return np.clip(boxes, np.tile(low, 2), np.tile(high, 2))


@lru_cache(maxsize=8)
def _extent(camera: Camera) -> NDArray[np.float64]:
    """Return the least and the greatest point (2, 2) of the plane z = 1 that an image shows."""
    steps = np.linspace(0.0, 1.0, _STEPS)
    grid = np.stack(np.meshgrid(steps * camera.width, steps * camera.height), axis=-1)
    points = camera.normalize_points(grid.reshape(-1, 2))
    points = points[np.isfinite(points).all(axis=1)]  # wide lenses show nothing in the corners
    if len(points) == 0:
        return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _overlaps(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU (n, m) of boxes (n, 4) and (m, 4)."""
    boxes = boxes[:, None]
    sides = np.minimum(boxes[..., 2:], others[:, 2:]) - np.maximum(boxes[..., :2], others[:, :2])
    shared = np.prod(np.maximum(sides, 0.0), axis=-1)
    areas = np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1)
    total = areas + np.prod(others[:, 2:] - others[:, :2], axis=-1) - shared
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(np.nan_to_num(shared / total))
