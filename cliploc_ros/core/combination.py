# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One answer from objects and keyframes: which pose, how sure, and whether the two contradict.

Objects and local features fail in different ways: objects are few and rough, features mistake
things that were moved. So a pose that both lead to is accepted sooner, and a contradiction
refuses a pose that either alone would accept.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import RIGHT_M, Support, agreeing_poses
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, Recognized
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization

# Log odds that the pose of keyframes is right: of the logarithm of its inliers, of the share of
# the image that is confirmed, of each detected object that the map explains there and of each
# that it does not. Rounded by hand on the kitchen's halves and on rooms that are not in the map,
# see cliploc_ros.evaluation.keyframes.
_INLIERS, _CONFIRMED, _EXPLAINED, _UNEXPLAINED, _NONE = 5.0, 6.0, 0.7, -0.7, -14.0
# Of the inliers, so many are lost for each that a pose elsewhere has.
_RIVAL_COUNTS = 3.0
_MOST_CONFIDENCE = 0.9999
# Features alone are accepted only where they confirm so much of the image. Objects whose pose
# elsewhere is so likely contradict the features.
_LEAST_CONFIRMED, _LEAST_INLIERS = 0.3, 20
# As many points elsewhere contradict a pose; of 231 right poses of the kitchen, none had more
# than 19. So does a share of the image that is much less than its inliers let expect, as where
# they lie on a poster: from a few inliers up to many.
_MOST_RIVAL = 20
_LEAST_OF_EXPECTED, _MORE_OF_EXPECTED, _MANY_INLIERS = 0.6, 0.32, 300
_CONTRADICTS = 0.5
# Weights of the first pose that covariance intersection tries.
_WEIGHTS = np.linspace(0.0, 1.0, 11)
# Detected objects of the map's classes contradict a pose that explains so few of them.
_MOST_UNEXPLAINED, _LEAST_EXPLAINED = 4, 0.25
# So many points elsewhere contradict accepted objects, whatever else they lack; a guess.
_CONTRADICTING_INLIERS = 100
# A detection is explained by a landmark of its class whose outline overlaps it so much.
_EXPLAINS_IOU = 0.2
# Poses of objects that propose keyframes.
_MOST_GUESSES = 3


class ObjectsThere(NamedTuple):
    """How many detected objects of the map's classes a pose explains, and how many not."""

    explained: int
    unexplained: int


_NO_OBJECTS = ObjectsThere(0, 0)


class Image(NamedTuple):
    """What an image with local features shows.

    Parameters
    ----------
    features : Features
    camera : Camera
        Of these features.
    observation : Observation
        The detected objects.
    """

    features: Features
    camera: Camera
    observation: Observation


def join_keyframes(found: Relocalization, image: Image, landmark_map: LandmarkMap,
                   localizer: KeyframeLocalizer, options: RelocalizerOptions,
                   deadline: float = math.inf) -> Relocalization:
    """Return the answer of objects and keyframes to an image.

    Parameters
    ----------
    found : Relocalization
        By objects.
    image : Image
    landmark_map : LandmarkMap
    localizer : KeyframeLocalizer
        Of the layer of this map.
    options : RelocalizerOptions
    deadline : float
        When no further keyframe is matched (monotonic clock) [s].
    """
    guesses = [one.map_from_camera for one in found.hypotheses][:_MOST_GUESSES]
    seen = localizer.localize_features(image.features, image.camera, guesses, deadline)
    if seen is None:
        return found
    there = objects_there(landmark_map, image.observation, seen.map_from_camera)
    return replace(combine(found, seen, there, options), recognized=seen)


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


def chance_recognized(seen: Recognized, there: ObjectsThere) -> float:
    """Return the probability that a pose of keyframes is within 1 m of the truth."""
    inliers = max(1.0, seen.inliers - _RIVAL_COUNTS * seen.rival)
    odds = (_NONE + _INLIERS * math.log(inliers) + _CONFIRMED * seen.confirmed
            + _EXPLAINED * there.explained + _UNEXPLAINED * there.unexplained)
    right = 1.0 / (1.0 + math.exp(-min(odds, 50.0)))
    if _inconsistent(seen, there):
        right = min(right, 0.5)
    return min(_MOST_CONFIDENCE, right) * share_within(RIGHT_M, seen.covariance)


def combine(found: Relocalization, seen: Recognized | None, there: ObjectsThere | None,
            options: RelocalizerOptions) -> Relocalization:
    """Return the answer of objects and keyframes together.

    Parameters
    ----------
    found : Relocalization
        By objects.
    seen : Recognized, optional
        By keyframes; None: the objects' answer stands.
    there : ObjectsThere, optional
        The objects around the pose of the keyframes.
    options : RelocalizerOptions
    """
    if seen is None or there is None:
        return found
    chance = chance_recognized(seen, there)
    agree = found.map_from_camera is not None and _agree(found.map_from_camera,
                                                         seen.map_from_camera)
    refusal = _refusal(seen, there, chance, options)
    if agree:
        return _both(found, seen, chance, refusal, options)
    if found.accepted:
        return replace(found, accepted=False, reason=_contradiction(found, seen)) \
            if _contradicts(seen, found, options) else found
    if not refusal and found.confidence >= _CONTRADICTS:
        refusal = _contradiction(found, seen)
    reason = f'{found.reason}; keyframes: {refusal}' if refusal else ''
    if refusal and found.confidence >= chance:
        return replace(found, reason=reason)
    return _with_pose(found, seen.map_from_camera, seen.covariance, chance, 'keyframes', reason)


def _inconsistent(seen: Recognized, there: ObjectsThere) -> str:
    """Return what in the image contradicts a pose of keyframes; empty where nothing does."""
    if seen.rival >= _MOST_RIVAL:
        return f'{seen.inliers} points agree, but {seen.rival} on another place'
    least = _LEAST_OF_EXPECTED + _MORE_OF_EXPECTED * min(1.0, seen.inliers / _MANY_INLIERS)
    if seen.confirmed < least * seen.expected:
        return (f'{seen.inliers} points agree, but only in {seen.confirmed:.0%} of the image; '
                'has something been moved?')
    known = there.explained + there.unexplained
    if there.unexplained >= _MOST_UNEXPLAINED and there.explained < _LEAST_EXPLAINED * known:
        return f'{there.unexplained} of {known} objects are not where the pose expects them'
    return ''


def _refusal(seen: Recognized, there: ObjectsThere, chance: float,
             options: RelocalizerOptions) -> str:
    """Return why the pose of keyframes is refused; empty if it is accepted."""
    if seen.inliers < _LEAST_INLIERS:
        return f'{seen.inliers} points agree < {_LEAST_INLIERS}'
    if seen.confirmed < _LEAST_CONFIRMED:
        return (f'{seen.confirmed:.0%} of the image shows what it should < '
                f'{_LEAST_CONFIRMED:.0%}')
    if inconsistent := _inconsistent(seen, there):
        return inconsistent
    if chance < options.min_confidence:
        rival = f', {seen.rival} elsewhere' if seen.rival else ''
        return (f'confidence {math.floor(chance * 100) / 100:.2f} < {options.min_confidence:g}, '
                f'{seen.inliers} points agree{rival}')
    return ''


def _both(found: Relocalization, seen: Recognized, chance: float, refusal: str,
          options: RelocalizerOptions) -> Relocalization:
    """Return the answer of two poses that agree.

    A strong pose of keyframes stays as it is: objects are rougher (measured on the kitchen's
    halves, fusing them cost .08 at .1 m). A weak one is fused. Each is wrong with its own
    probability, and both lead to the same wrong place only by chance: the product is an upper
    bound where their errors are independent.
    """
    assert found.map_from_camera is not None and found.covariance is not None
    pose, covariance = (seen.map_from_camera, seen.covariance) if not refusal else fuse(
        found.map_from_camera, found.covariance, seen.map_from_camera, seen.covariance)
    confidence = min(_MOST_CONFIDENCE, 1.0 - (1.0 - found.confidence) * (1.0 - chance))
    reason = '' if found.accepted or confidence >= options.min_confidence else \
        f'{found.reason}; keyframes: {refusal}'
    return _with_pose(found, pose, covariance, confidence, 'both', reason)


def _with_pose(found: Relocalization, pose: NDArray[np.float64],
               covariance: NDArray[np.float64], confidence: float, source: str, reason: str
               ) -> Relocalization:
    """Return a result with another best pose; the objects' hypotheses elsewhere follow."""
    best = found.hypotheses[0] if source == 'both' else None
    others = tuple(one for one in found.hypotheses
                   if one is not best and not _agree(one.map_from_camera, pose))
    leading = Hypothesis(pose, best.score if best else 0.0, confidence,
                         best.support if best else Support())
    return replace(found, accepted=not reason, reason=reason, hypotheses=(leading, *others),
                   matches=found.matches if best else (), covariance=covariance, source=source)


def fuse(first: NDArray[np.float64], first_covariance: NDArray[np.float64],
         second: NDArray[np.float64], second_covariance: NDArray[np.float64]
         ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of two poses (4, 4) and its covariance (6, 6).

    Both share the errors of the map, to an unknown degree. Covariance intersection is right for
    any degree (Julier and Uhlmann, "A Non-divergent Estimation Algorithm in the Presence of
    Unknown Correlations", 1997). The weight gives the least variance of the position, so a pose
    that is better in every direction stays as it is. The covariances are in the order of
    core.fit.covariance.
    """
    informations = np.linalg.inv(first_covariance), np.linalg.inv(second_covariance)
    covariances = [np.linalg.inv(weight * informations[0] + (1.0 - weight) * informations[1])
                   for weight in _WEIGHTS]
    best = int(np.argmin([np.trace(one[:3, :3]) for one in covariances]))
    covariance = (covariances[best] + covariances[best].T) / 2
    step = np.concatenate([first[:3, 3] - second[:3, 3],
                           Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_rotvec()])
    moved = _WEIGHTS[best] * covariance @ informations[0] @ step
    turn = Rotation.from_rotvec(moved[3:]).as_matrix()
    return make_transform(turn @ second[:3, :3], second[:3, 3] + moved[:3]), covariance


def _contradicts(seen: Recognized, found: Relocalization, options: RelocalizerOptions) -> bool:
    """Return whether keyframes contradict accepted objects elsewhere.

    Of two contradicting sources neither judges the other: the objects do not count here. Where
    the second best place of the keyframes is the objects' own, as in two equal rooms, the objects
    decide.
    """
    assert found.map_from_camera is not None
    if seen.rival_pose is not None and _agree(seen.rival_pose, found.map_from_camera):
        return False
    alone = _refusal(seen, _NO_OBJECTS, chance_recognized(seen, _NO_OBJECTS), options)
    return not alone or seen.inliers >= _CONTRADICTING_INLIERS


def _contradiction(found: Relocalization, seen: Recognized) -> str:
    assert found.map_from_camera is not None
    apart = np.linalg.norm(found.map_from_camera[:3, 3] - seen.map_from_camera[:3, 3])
    return (f'objects and keyframes contradict each other, their poses are {apart:.2f} m apart; '
            'turn the camera to more objects')


def _agree(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool(agreeing_poses(np.stack([one, other]))[0, 1])


def _inside(boxes: NDArray[np.float64], observation: Observation) -> NDArray[np.float64]:
    """Return boxes (n, 4) of the plane z = 1, cut at the border of the image."""
    camera = observation.camera
    corners = camera.normalize_points(np.array([[0.0, 0.0], [camera.width, camera.height]]))
    corners = np.nan_to_num(corners, nan=0.0)
    return np.clip(boxes, np.tile(corners.min(axis=0), 2), np.tile(corners.max(axis=0), 2))


def _overlaps(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU (n, m) of boxes (n, 4) and (m, 4)."""
    boxes = boxes[:, None]
    sides = np.minimum(boxes[..., 2:], others[:, 2:]) - np.maximum(boxes[..., :2], others[:, :2])
    shared = np.prod(np.maximum(sides, 0.0), axis=-1)
    areas = np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1)
    total = areas + np.prod(others[:, 2:] - others[:, :2], axis=-1) - shared
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(np.nan_to_num(shared / total))
