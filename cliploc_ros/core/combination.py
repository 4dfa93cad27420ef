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

from cliploc_ros.core.acceptance.agreement import agreeing_poses
from cliploc_ros.core.acceptance.confidence import MOST_CONFIDENCE
from cliploc_ros.core.acceptance.recognition import (
    NO_OBJECTS,
    ObjectsThere,
    chance_recognized,
    objects_there,
    refusal_of,
)
from cliploc_ros.core.acceptance.refusal_kind import RefusalKind
from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, Recognition, RecognizedPlace
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.core.search.frame_search import prior_of

# Objects whose pose elsewhere is so likely contradict the features.
_CONTRADICTS = 0.5
# Weights of the first pose that covariance intersection tries.
_WEIGHTS = np.linspace(0.0, 1.0, 11)
# So many points elsewhere contradict accepted objects, whatever else they lack; a guess.
_CONTRADICTING_INLIERS = 100
# A dozen points can agree on a pose that is far off, by more than their covariance says: on the
# demo, 12 points were wrong by .89 m and claimed some 4 cm. From so many points on, poses of the
# kitchen were as good as their covariance, whatever else made them weak. A guess.
_GOOD_COVARIANCE_INLIERS = 40
# Poses of objects that propose keyframes.
_MOST_GUESSES = 3


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
    seen = localizer.localize_features(image.features, image.camera, guesses, deadline,
                                       prior_of(image.observation, options))
    there = objects_there(landmark_map, image.observation, seen.places[0].map_from_camera
                          ) if seen.places else None
    return replace(combine(found, seen, there, options), recognized=seen)


def combine(found: Relocalization, seen: Recognition, there: ObjectsThere | None,
            options: RelocalizerOptions) -> Relocalization:
    """Return the answer of objects and keyframes together.

    Parameters
    ----------
    found : Relocalization
        By objects.
    seen : Recognition
        By keyframes; without places the objects' answer stands.
    there : ObjectsThere, optional
        The objects around the first place of the keyframes.
    options : RelocalizerOptions
    """
    if not seen.places or there is None:
        return found
    first, chance = seen.places[0], chance_recognized(seen, there)
    agree = found.map_from_camera is not None and _agree(found.map_from_camera,
                                                         first.map_from_camera)
    refusal = refusal_of(seen, there, chance, options)
    if agree:
        return _both(found, first, chance, refusal, options)
    if found.accepted and not _contradicts(seen, found, options):
        return found
    if found.accepted or (not refusal and found.confidence >= _CONTRADICTS):
        refusal = _contradiction(found, first)
        found = replace(found, accepted=False, refusal_kind=RefusalKind.CONTRADICTION)
    reason = '; keyframes: '.join(filter(None, (found.reason, refusal))) if refusal else ''
    if refusal and found.confidence >= chance:  # of two refused poses, the likelier leads
        return replace(found, reason=reason)
    return _with_pose(found, first.map_from_camera, first.covariance, chance, 'keyframes', reason)


def _both(found: Relocalization, seen: RecognizedPlace, chance: float, refusal: str,
          options: RelocalizerOptions) -> Relocalization:
    """Return the answer of two poses that agree.

    A strong pose of keyframes stays as it is: objects are rougher (measured on the kitchen's
    halves, fusing them cost .08 at .1 m). A weak one is fused, with a larger covariance if it
    has few points. Each is wrong with its own probability, and both lead to the same wrong place
    only by chance: the product is an upper bound where their errors are independent.
    """
    assert found.map_from_camera is not None and found.covariance is not None
    pose, covariance = (seen.map_from_camera, seen.covariance) if not refusal else fuse(
        found.map_from_camera, found.covariance, seen.map_from_camera,
        max(1.0, _GOOD_COVARIANCE_INLIERS / seen.inliers) ** 4 * seen.covariance)
    confidence = min(MOST_CONFIDENCE, 1.0 - (1.0 - found.confidence) * (1.0 - chance))
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
    return replace(found, accepted=not reason, reason=reason,
                   refusal_kind=found.refusal_kind if reason else None,
                   hypotheses=(leading, *others), matches=found.matches if best else (),
                   covariance=covariance, source=source)


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


def _contradicts(seen: Recognition, found: Relocalization, options: RelocalizerOptions) -> bool:
    """Return whether keyframes contradict accepted objects elsewhere.

    Of two contradicting sources neither judges the other: the objects do not count here. Where
    the second best place of the keyframes is the objects' own, as in two equal rooms, the objects
    decide.
    """
    assert found.map_from_camera is not None
    if len(seen.places) > 1 and _agree(seen.places[1].map_from_camera, found.map_from_camera):
        return False
    alone = refusal_of(seen, NO_OBJECTS, chance_recognized(seen, NO_OBJECTS), options)
    return not alone or seen.places[0].inliers >= _CONTRADICTING_INLIERS


def _contradiction(found: Relocalization, seen: RecognizedPlace) -> str:
    assert found.map_from_camera is not None
    apart = np.linalg.norm(found.map_from_camera[:3, 3] - seen.map_from_camera[:3, 3])
    return (f'objects and keyframes contradict each other, their poses are {apart:.2f} m apart; '
            'turn the camera to more objects')


def _agree(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool(agreeing_poses(np.stack([one, other]))[0, 1])
