# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of all sources compared: the likeliest one, and the evidence for and against it.

Poses that the search of objects met and poses that keyframes recognized compete in one list. Each
is measured on the detections of all frames and on the points of the keyframes. The likeliest one
leads, and the evidence for it is all that decides whether it is accepted.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.camera_check import CALIBRATED
from cliploc_ros.core.acceptance.confidence import (
    chance_by_points,
    confidences,
    none_right,
    objects_utility,
    points_utility,
)
from cliploc_ros.core.acceptance.contenders import (
    Contender,
    JoinedFrames,
    contenders_of,
    refined,
    unrefined,
)
from cliploc_ros.core.acceptance.genuine import Motion, Signs, compare_motion, signs_of
from cliploc_ros.core.acceptance.look_alikes import find_twins, lead_over_twin, turned_about_axis
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.mirror import chance_not_mirrored
from cliploc_ros.core.acceptance.verdict import Evidence, Rival, is_exhaustive
from cliploc_ros.core.fit.covariance import fuse, share_within
from cliploc_ros.core.fit.finalists import (
    Finalist,
    covariance_of,
    meetings_of,
)
from cliploc_ros.core.geometry.transforms import RIGHT_M, SAME_ANSWER, SAME_PLACE
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.map.joined_map import Place, place_of
from cliploc_ros.core.search.frame_search import constraint_of, coverage_of
from cliploc_ros.core.search.strategies import MAX_DISTINCT

# The most poses of objects that propose keyframes.
_MOST_GUESSES = 3


def spread(poses: NDArray[np.float64], odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of the differences between a pose and those that agree with it.

    The right pose need not be among those found. So their mean square is added in all directions,
    too.

    Parameters
    ----------
    poses : ndarray (m, 4, 4)
        map_from_camera; the first one is the pose.
    odds : ndarray (m,)
        Logarithm of the odds of each, up to a constant.

    Returns
    -------
    ndarray (6, 6)
        Of position [m] and rotation about the map's axes [rad].
    """
    agreeing = SAME_ANSWER.agreeing(poses)[0]
    # poses near each other share landmarks and errors: their supports differ by less than they say
    weights = np.exp(CALIBRATION.covariance.sharpness * (odds[agreeing] - odds[agreeing].max()))
    turns = Rotation.from_matrix(poses[agreeing, :3, :3] @ poses[0, :3, :3].T).as_rotvec()
    steps = np.concatenate([poses[agreeing, :3, 3] - poses[0, :3, 3], turns], axis=1)
    squares = (steps.T * (weights / weights.sum())) @ steps
    anywhere = np.repeat([np.trace(squares[:3, :3]) / 3, np.trace(squares[3:, 3:]) / 3], 3)
    return np.asarray(squares + np.diag(anywhere))


class Comparison(NamedTuple):
    """The contenders, and what decides between them."""

    #: The leading one first; of those of one source, one of each place
    contenders: list[Contender]
    poses: NDArray[np.float64]  #: (m, 4, 4)
    likely: NDArray[np.float64]  #: (m,): probability of each, shared by those that agree
    recognition: Recognition | None  #: What keyframes say
    leading: NDArray[np.bool_]  #: (m,): which contenders agree with the leading one

    @property
    def source(self) -> str:
        """Return what proposes the leading place: 'objects', 'keyframes' or 'both'."""
        if self.by_objects is None:
            return 'keyframes'
        return 'objects' if self.by_keyframes is None else 'both'

    @property
    def by_objects(self) -> Contender | None:
        """Return the best contender of the leading place that the search of objects met."""
        return next((one for one, near in zip(self.contenders, self.leading, strict=True)
                     if near and one.recognized is None), None)

    @property
    def by_boxes(self) -> Contender | None:
        """Return by_objects if its boxes decide where the pose is; None if points do."""
        place = None if self.by_keyframes is None else self.by_keyframes.recognized
        return self.by_objects if place is None or (
            place.inliers < CALIBRATION.keyframes.good_covariance) else None

    @property
    def by_keyframes(self) -> Contender | None:
        """Return the best contender of the leading place that keyframes propose."""
        return next((one for one, near in zip(self.contenders, self.leading, strict=True)
                     if near and one.recognized is not None), None)


def search_contenders(joined: JoinedFrames, finalists: Sequence[Finalist],
                      is_upright: NDArray[np.bool_]) -> list[Contender]:
    """Return the poses that the search met as contenders, one of each place, best first.

    Poses that ignore the known vertical (not is_upright, (m,)) come last. Without refinement the
    greatest score is first, as in the paper.
    """
    contenders = contenders_of(joined, finalists, is_upright.tolist())
    if not joined.options.refine:
        return contenders
    contenders.sort(key=lambda one: -one.rank)
    kinds = [[one for one in contenders if one.is_upright == known] for known in (True, False)]
    return [some[row] for some in kinds for row in SAME_PLACE.distinct(
        np.array([one.pose for one in some]).reshape(-1, 4, 4), MAX_DISTINCT)]


def compare(joined: JoinedFrames, contenders: list[Contender],
            recognizer: ImageRecognizer | None = None) -> Comparison:
    """Return the contenders of the search compared with the places that keyframes recognize.

    There are none where neither source has any. The recognizer is of the keyframes, for the last
    image.
    """
    seen = None
    if recognizer is not None:
        seen = recognizer.recognize([one.pose for one in contenders[:_MOST_GUESSES]],
                                    constraint_of(joined.frames[-1].observation, joined.options))
        contenders = [one._replace(odds=one.odds + _missed(one.pose, seen, recognizer))
                      for one in contenders]
        contenders += _proposed(joined, seen, contenders)
        contenders.sort(key=lambda one: (not one.is_upright, -one.rank))
    poses = np.array([one.pose for one in contenders]).reshape(-1, 4, 4)
    return Comparison(contenders, poses, confidences(
        np.array([one.odds for one in contenders]), poses, none_right(joined.setting),
        prior=np.array([one.prior for one in contenders])), seen,
        SAME_ANSWER.agreeing(poses[:1], poses).ravel())


def _proposed(joined: JoinedFrames, seen: Recognition, met: Sequence[Contender]
              ) -> list[Contender]:
    """Return the places that keyframes recognize, as contenders.

    Points add to the odds of the pose that the search of objects met there, if there is one. They
    never take any: a dozen points agree by chance.
    """
    none, most = none_right(joined.setting), CALIBRATION.attitude.vertical_sigmas
    found = contenders_of(joined, [unrefined(one.map_from_camera) for one in seen.places],
                          [one.tilt_error <= most for one in seen.places])
    proposed = []
    for one, place in zip(found, seen.places, strict=True):
        points, objects = points_utility(place), objects_utility(one.support)
        alone = none + points - one.handicap
        there = [other.odds for other in met if SAME_ANSWER.agree(one.pose, other.pose)]
        proposed.append(one._replace(
            recognized=place, by_points=alone + min(0.0, objects),
            odds=max([alone + objects, *(odds + max(0.0, points) for odds in there)])))
    return proposed


def _missed(pose: NDArray[np.float64], seen: Recognition, recognizer: ImageRecognizer) -> float:
    """Return the evidence against a pose (4, 4) that keyframes near it do not recognize."""
    if not seen.is_complete or any(SAME_ANSWER.agree(pose, one.map_from_camera)
                                   for one in seen.places):
        return 0.0
    return CALIBRATION.keyframes.missed * recognizer.coverage(pose)


def pose_of(joined: JoinedFrames, compared: Comparison
            ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose (4, 4) of the leading place and its covariance (6, 6).

    A pose of many points stays as it is: objects are rougher. One of few points can be off by
    more than its covariance says, so it is made less certain, and fused with that of the objects.
    """
    by_objects, by_keyframes = compared.by_objects, compared.by_keyframes
    found = None
    if by_objects is not None:
        covariance = covariance_of(joined.frames, joined.rig, by_objects.finalist,
                                   joined.landmark_map.shared_sigmas,
                                   joined.options.mount_deviation, CALIBRATED)
        if by_objects.finalist.information is not None:
            others = [one for one in compared.contenders if one.recognized is None]
            others.sort(key=lambda one: one is not by_objects)
            covariance = covariance + spread(np.array([one.pose for one in others]),
                                             np.array([one.odds for one in others]))
        found = by_objects.pose, covariance
    if by_keyframes is None or by_keyframes.recognized is None:
        assert found is not None
        return found
    place = by_keyframes.recognized
    doubt = max(1.0, CALIBRATION.keyframes.good_covariance / place.inliers) ** 4
    if found is None or doubt == 1.0:
        return by_keyframes.pose, doubt * place.covariance
    return fuse(*found, by_keyframes.pose, doubt * place.covariance)


def evidence_of(joined: JoinedFrames, compared: Comparison, covariance: NDArray[np.float64],
                looks: Looks, recognizer: ImageRecognizer | None = None) -> Evidence:
    """Return the evidence for the leading pose.

    Parameters
    ----------
    covariance : ndarray (6, 6)
        Of the leading pose.
    """
    best, place = compared.by_objects or compared.contenders[0], compared.by_keyframes
    coverage, last = coverage_of(joined.frames), joined.frames[-1].observation
    distinct, twin = _distinct(joined, compared, recognizer)
    by_points = _by_points(joined, compared)
    return Evidence(
        round(best.support.inliers), float(compared.likely[0]), by_points=by_points,
        rival=_rival(joined, compared), distinct=distinct,
        place=place_of(joined.landmark_map, compared.poses[0]).position,
        twin=twin and twin.position, twin_map=twin.name if twin else '',
        # the covariance of a minimal sample is too rough to decide
        near=1.0 if place is None and best.finalist.information is None
        else share_within(RIGHT_M, CALIBRATION.covariance.caution * covariance),
        deviation_m=math.sqrt(np.trace(covariance[:3, :3])), coverage=coverage,
        tried=sum(one.known_tried for one in joined.frames),
        meetings=math.inf if is_exhaustive(coverage, joined.options)
        or compared.by_objects is None
        else meetings_of(joined.frames, best.finalist, best.matches),
        unexplained=best.support.unexplained, signs=_signs(joined, compared),
        motion=_motion(joined, compared, looks, recognizer),
        not_mirrored=_not_mirrored(joined, compared, by_points),
        uncontradicted=_uncontradicted(joined, compared),
        recognized=place and place.recognized, prior=compared.contenders[0].prior,
        earlier=looks.confidences_in(last, compared.poses[0]),
        crops_left=0 if last.compared is None else len(last.detections) - len(last.compared))


def _signs(joined: JoinedFrames, compared: Comparison) -> Signs | None:
    """Return the signs that the leading place is no picture; None if keyframes do not propose it.

    In the last frame, since keyframes are recognized there.
    """
    place, last = compared.by_keyframes, joined.frames[-1].observation
    if place is None or place.recognized is None or compared.recognition is None:
        return None
    best = compared.by_objects or place
    boxes = last.detections.bboxes_xyxy[[one.detection for one in best.matches[-1]]]
    return signs_of(place.recognized, best.support, boxes, last.camera, max(
        (one.inliers for one in compared.recognition.places if one is not place.recognized),
        default=0))


def _motion(joined: JoinedFrames, compared: Comparison, looks: Looks,
            recognizer: ImageRecognizer | None) -> Motion | None:
    """Return the motion since an earlier look by keyframes, if there was one."""
    place, passed = compared.by_keyframes, looks.passed(joined.frames[-1].observation)
    if (place is None or place.recognized is None or recognizer is None
            or passed is None or passed[0].recognized is None):
        return None
    return compare_motion(recognizer.deviation_per_metre, passed[0].recognized, place.recognized,
                          passed[1])


def _not_mirrored(joined: JoinedFrames, compared: Comparison, by_points: float) -> float:
    """Return the probability that the image is no mirror image.

    Features of a mirror image match nothing, so keyframes exclude it, where they are sure. A pose
    that is refused anyway is not worth the time.
    """
    best, options = compared.by_objects, joined.options
    if (best is None or not options.refine or by_points >= options.min_confidence
            or compared.likely[0] < options.min_confidence
            or round(best.support.inliers) < options.min_inliers):
        return 1.0
    return chance_not_mirrored(joined, best)


def _uncontradicted(joined: JoinedFrames, compared: Comparison) -> float:
    """Return the probability that keyframes are wrong which recognize another place only.

    They count where they are sure. What a dozen points say is in the comparison.
    """
    chance = max((chance_by_points(one.recognized) for one in compared.contenders
                  if one.recognized is not None), default=0.0)
    if compared.by_keyframes is not None or chance < joined.options.min_confidence:
        return 1.0
    return 1.0 - chance


def _rival(joined: JoinedFrames, compared: Comparison) -> Rival | None:
    """Return the likeliest pose that does not agree with the leading one."""
    others = np.nonzero(~compared.leading)[0]
    if len(others) == 0:
        return None
    row = others[np.argmax(compared.likely[others])]
    place = place_of(joined.landmark_map, compared.poses[row])
    same_source = compared.by_objects if compared.contenders[row].recognized is None \
        else compared.by_keyframes
    return Rival(min(float(compared.likely[row]), 1.0 - float(compared.likely[0])),
                 place.position, place.name, same_source is None)


def _by_points(joined: JoinedFrames, compared: Comparison) -> float:
    """Return the probability of the leading place without what objects say for it."""
    if compared.by_keyframes is None:
        return 0.0
    rows = [row for row, (one, near) in enumerate(zip(compared.contenders, compared.leading,
                                                      strict=True))
            if one.recognized is not None or not near]
    odds = [one.by_points if near else one.odds for one, near in zip(
        compared.contenders, compared.leading, strict=True)]
    priors = np.array([one.prior for one in compared.contenders])
    found = confidences(np.array(odds)[rows], compared.poses[rows], none_right(joined.setting),
                        prior=priors[rows])
    return float(max(found[number] for number, row in enumerate(rows) if compared.leading[row]))


def _distinct(joined: JoinedFrames, compared: Comparison, recognizer: ImageRecognizer | None
              ) -> tuple[float, Place | None]:
    """Return the probability that no place that looks alike has the leading pose's camera.

    Next to it is where the camera would be at the likeliest of these places. Keyframes tell a
    twin apart as far as they cover it.
    """
    best, (low, high) = compared.contenders[0], joined.options.height_range_m
    twins, alike = find_twins(joined.landmark_map, best.pose, best.landmarks,
                              compared.poses[~compared.leading])
    turned = turned_about_axis(joined.landmark_map, best.pose, best.landmarks)
    found = np.concatenate([twins, turned])
    rooms = np.append(alike.are_rooms, np.zeros(len(turned), dtype=np.bool_))
    inside = np.nonzero((low <= found[:, 2, 3]) & (found[:, 2, 3] <= high))[0]
    places = [refined(joined, unrefined(found[row])) for row in inside]
    poses = np.array([best.pose, *(one.map_from_camera for one in places)])
    # a place that refinement moved back to the leading pose is no other one
    elsewhere = ~SAME_ANSWER.agreeing(poses)[0]
    # of each place, the first
    before = np.tril(SAME_PLACE.agreeing(poses) & elsewhere, -1)
    others = np.nonzero(elsewhere & ~before.any(axis=1))[0]
    if len(others) == 0:
        return 1.0, None
    rows = inside[others - 1]
    rivals = contenders_of(joined, [places[row - 1] for row in others], [True] * len(others))
    leads = _leads_of_points(compared, poses[others], rooms[rows], recognizer)
    for number, (rival, row) in enumerate(zip(rivals, rows, strict=True)):
        if row < len(twins):
            by_objects = lead_over_twin(best.support, rival.support, float(alike.shares[row]),
                                        bool(rooms[row]))
        else:  # as much as if the search had met it, see confidences
            by_objects = (1.0 + CALIBRATION.objects.slope) * (best.odds - rival.odds)
        leads[number] += best.prior - rival.prior + by_objects
    chance = float(1.0 / (1.0 + np.exp(-np.clip(leads, -50.0, 50.0)).sum()))
    return chance, place_of(joined.landmark_map, poses[others][int(np.argmin(leads))])


def _leads_of_points(compared: Comparison, twins: NDArray[np.float64],
                     are_rooms: NDArray[np.bool_], recognizer: ImageRecognizer | None
                     ) -> NDArray[np.float64]:
    """Return the log odds (m,) by which keyframes prefer the leading place to each twin.

    They say nothing about a room of its own that they do not cover: it may show the same points.
    """
    leading = compared.by_keyframes
    if recognizer is None or leading is None or leading.recognized is None:
        return np.zeros(len(twins))
    covered = np.array([recognizer.coverage(pose) for pose in [leading.pose, *twins]])
    known = np.where(are_rooms, np.minimum(1.0, covered[1:] / max(covered[0], 1e-9)), 1.0)
    theirs = np.array([max([0.0] + [
        points_utility(one.recognized) for one in compared.contenders
        if one.recognized is not None and SAME_ANSWER.agree(one.pose, pose)]) for pose in twins])
    return np.maximum(0.0, known * max(0.0, points_utility(leading.recognized)) - theirs)
