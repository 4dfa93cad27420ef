# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the poses of all sources: find the most likely pose, and the evidence about it.

The poses found by the search of objects and the poses found by keyframes compete in one list. Each
pose is scored on the detections of all frames and on the points of the keyframes. The most likely
pose leads, and the evidence about it alone decides whether it is accepted.

An image may be mirrored, by a mirror or a flipped camera. A wrong pose may then explain it well: a
camera on the other side of a plane sees the points of the plane mirrored, at the same distances.
For example, it sees objects on a table from below, or objects along a wall from behind. The image
is therefore mirrored back, and the best pose of the mirrored image competes with the pose found. A
short search of the mirrored image and reflections of the camera in planes through the matched
objects find it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.camera_check import CALIBRATED
from cliploc_ros.core.acceptance.confidence import (
    confidences,
    objects_utility,
    points_utility,
    tagged_objects_utility,
    tags_utility,
    utilities,
)
from cliploc_ros.core.acceptance.contenders import Contender, JoinedFrames, join_frames, unrefined
from cliploc_ros.core.acceptance.genuine import Motion, Signs, compare_motion, signs_of
from cliploc_ros.core.acceptance.look_alikes import find_twins, lead_over_twin, turned_about_axis
from cliploc_ros.core.acceptance.looks import NO_LOOKS, Looks
from cliploc_ros.core.acceptance.verdict import Evidence, Rival
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import POSE_UNKNOWN, fuse, refined_covariance, shares_within
from cliploc_ros.core.fit.finalists import Finalist, find_finalists, matches_of, meetings_of
from cliploc_ros.core.fit.tag_pose import find_tag_places
from cliploc_ros.core.fit.verification import verify_rig
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import RIGHT_M, SAME_ANSWER, SAME_PLACE, move_covariance
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.map.joined_map import Place, place_of
from cliploc_ros.core.map.visibility import expect
from cliploc_ros.core.observation import tilt_deg
from cliploc_ros.core.options import NEVER
from cliploc_ros.core.search.frame_search import constraint_of, coverage_of, search_frame
from cliploc_ros.core.search.strategies import MAX_DISTINCT

_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])
_UP = np.array([0.0, 0.0, 1.0])


def search_contenders(joined: JoinedFrames, finalists: Sequence[Finalist],
                      is_upright: NDArray[np.bool_]) -> list[Contender]:
    """Return the poses found by the search as contenders, one for each place, best first.

    Poses that ignore the known vertical (not is_upright, (m,)) come last. Without refinement, the
    pose with the greatest score comes first, as in the paper.
    """
    contenders = joined.contenders(finalists, is_upright.tolist())
    if not joined.options.refine:
        return contenders
    contenders.sort(key=lambda contender: -contender.rank)
    kinds = [[contender for contender in contenders if contender.is_upright == upright]
             for upright in (True, False)]
    return [kind[row] for kind in kinds for row in SAME_PLACE.distinct(
        np.array([contender.pose for contender in kind]).reshape(-1, 4, 4), MAX_DISTINCT)]


class Comparison:
    """The contenders, and the evidence that decides between them.

    Parameters
    ----------
    met : sequence of Contender
        Contenders found by the search of objects.
    looks : Looks, optional
        Earlier looks, which must agree with the pose.
    recognizer : ImageRecognizer, optional
        Search of keyframes for the last image. The places that it recognizes compete, too.
    """

    def __init__(self, joined: JoinedFrames, met: Sequence[Contender], looks: Looks = NO_LOOKS,
                 recognizer: ImageRecognizer | None = None) -> None:
        self._joined, self._looks, self._recognizer = joined, looks, recognizer
        self._last, self._none = joined.frames[-1].observation, joined.none_right
        tagged = self._tagged(met) if joined.landmark_map.tags else []
        contenders, seen = sorted([*met, *tagged], key=_order) if tagged else list(met), None
        if recognizer is not None:
            guesses = contenders[:int(CALIBRATION.keyframes.guesses)]
            seen = recognizer.recognize([guess.pose for guess in guesses],
                                        constraint_of(self._last, joined.options))
            if seen.is_complete:  # a pose is less likely where keyframes cover it but do not match
                places = np.array([place.map_from_camera
                                   for place in seen.places]).reshape(-1, 4, 4)
                contenders = [
                    contender if SAME_ANSWER.agreeing(contender.pose[None], places).any()
                    else _missed(contender, recognizer) for contender in contenders]
            contenders += self.proposed(seen, contenders)
            contenders.sort(key=_order)
        #: The leading contender first; each source has at most one contender for each place
        self.contenders = contenders
        #: (m, 4, 4): map_from_camera of each contender
        self.poses = np.array([contender.pose for contender in contenders]).reshape(-1, 4, 4)
        rows = np.arange(len(contenders))
        # A small group weakens the leading pose of objects. It does not choose between poses, and
        # takes nothing from points.
        group = contenders[0].support.group if contenders and contenders[0].is_of_objects \
            else 0.0
        #: (m,): probability of each contender; contenders that agree share one probability
        self.likely = self._confidences(rows, [contender.odds - group for contender in contenders])
        self.recognition = seen  #: Result of the search of keyframes
        #: (m,): whether each contender agrees with the leading one
        self.leading = SAME_ANSWER.agreeing(self.poses[:1], self.poses).ravel()
        agreeing = [contenders[row] for row in rows[self.leading]]
        #: The best contender at the leading place that the search of objects found
        self.by_objects = next((contender for contender in agreeing
                                if contender.is_of_objects), None)
        self._by_keyframes = next((contender for contender in agreeing
                                   if contender.recognized is not None), None)
        #: The leading place if keyframes recognize it; else None
        self.place = self._by_keyframes.recognized if self._by_keyframes else None
        self._by_tags = next((contender for contender in agreeing
                              if contender.tagged is not None), None)

    @property
    def source(self) -> str:
        """Return the source of the leading place: 'objects', 'keyframes', 'tags' or 'both'."""
        sources = [name for name, by in (
            ('objects', self.by_objects), ('keyframes', self.place),
            ('tags', self._by_tags)) if by]
        return sources[0] if len(sources) == 1 else 'both'

    @property
    def by_boxes(self) -> Contender | None:
        """Return by_objects if the pose depends on its boxes; None if points determine it."""
        is_sure = self._by_points >= self._joined.options.min_confidence or (
            self.place is not None
            and self.place.inliers >= CALIBRATION.keyframes.good_covariance)
        return None if is_sure else self.by_objects

    def _confidences(self, rows: NDArray[np.int64], odds: Sequence[float]
                     ) -> NDArray[np.float64]:
        """Return the probabilities (r,) of the contenders of some rows, given their odds."""
        return confidences(np.array(odds), self.poses[rows], self._none, prior=np.array(
            [self.contenders[row].prior for row in rows]))

    def proposed(self, seen: Recognition, met: Sequence[Contender]) -> list[Contender]:
        """Return the places that keyframes recognize, as contenders.

        If the search of objects found a pose at the same place, the points add to its odds. They
        never lower them: a dozen points agree by chance. Objects never lower the odds of points
        either: the objects that the pose does not explain may never have been mapped.
        """
        most = CALIBRATION.attitude.vertical_sigmas
        found = self._joined.contenders(
            [unrefined(place.map_from_camera) for place in seen.places],
            [place.tilt_error <= most for place in seen.places])
        return [self._named(contender, met, points_utility(place), objects_utility(
            contender.support), recognized=place) for contender, place in zip(
                found, seen.places, strict=True)]

    def _named(self, contender: Contender, met: Sequence[Contender], utility: float,
               objects: float, against: float = 0.0, **source: Any) -> Contender:
        """Return a contender of keyframes or tags with its odds.

        The evidence of objects for it does not count where objects have no say, that against it
        does. A pose that others found at the same place adds its own odds.
        """
        alone = self._none + utility + against - contender.handicap
        near = [other for other in met if SAME_ANSWER.agree(contender.pose, other.pose)]
        return contender._replace(
            by_points=max([alone, *(other.by_points + max(0.0, utility) for other in near)]),
            odds=max([alone + max(0.0, objects),
                      *(other.odds + max(0.0, utility) for other in near)]), **source)

    def _tagged(self, met: Sequence[Contender]) -> list[Contender]:
        """Return the places that tags of the newest instant name, one for each place.

        Tags add to the odds of a pose that objects found at the same place, as keyframes do.
        """
        joined, most = self._joined, CALIBRATION.attitude.vertical_sigmas
        found = list[Contender]()
        constraint = constraint_of(self._last, joined.options)
        for frame, camera, instant in zip(joined.frames, joined.cameras, joined.instants,
                                          strict=True):
            for place in find_tag_places(joined.landmark_map.tags, frame.observation) if (
                    instant == joined.instants[-1]) else ():
                pose = place.map_from_camera @ camera
                place = place._replace(map_from_camera=pose, covariance=move_covariance(
                    place.covariance, pose[:3, 3] - place.map_from_camera[:3, 3]))
                contender, = joined.contenders([unrefined(pose)], [
                    constraint.tilt_error(pose, place.covariance) <= most])
                objects = tagged_objects_utility(contender.support, joined.compared)
                if constraint.allows(pose):
                    found.append(self._named(contender, met, tags_utility(place), objects,
                                             min(0.0, objects), tagged=place))
        found.sort(key=_order)
        poses = np.array([contender.pose for contender in found]).reshape(-1, 4, 4)
        odds, rows = np.array([contender.odds for contender in found]), np.arange(len(found))
        # flips near each other make a pose uncertain
        return [found[row]._replace(spread=spread(poses[order], odds[order]))
                for row in SAME_ANSWER.distinct(poses)
                for order in [np.r_[row, np.delete(rows, row)]]]

    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pose (4, 4) of the leading place and its covariance (6, 6).

        A pose that points alone confirm, or from many points, is returned unchanged, because
        objects are less accurate. The error of a pose from few points may exceed its covariance.
        Its covariance is therefore increased, and the pose is fused with that of the objects.
        """
        best, by_points = self.by_boxes, None
        if self._by_keyframes is not None and self.place is not None:
            terms = CALIBRATION.keyframes
            doubt = max(1.0, terms.good_covariance / self.place.inliers) ** terms.doubt_power
            by_points = self._by_keyframes.pose, doubt * self.place.covariance
        if self._by_tags is not None and self._by_tags.tagged is not None:
            by_tags = self._by_tags.pose, (self._by_tags.tagged.covariance
                                           + self._by_tags.spread)
            if self.by_objects and not SAME_PLACE.agree(by_tags[0], self.by_objects.pose):
                # a tag of a wrong size or displaced by less than a metre
                by_tags = by_tags[0], by_tags[1] + spread(
                    np.array([by_tags[0], self.by_objects.pose]), np.zeros(2))
            by_points = by_tags if by_points is None else fuse(*by_points, *by_tags)
        if by_points is not None and best is None:
            return by_points
        assert best is not None
        joined = self._joined
        finalist, covariance = best.finalist, POSE_UNKNOWN
        if finalist.information is None or finalist.information.any():
            covariance = refined_covariance(
                joined.rig, finalist.rotation, finalist.translation, joined.instants,
                joined.landmark_map.shared_sigmas, CALIBRATION.covariance.wrong_share,
                joined.options.mount_deviation, CALIBRATED)
        if finalist.information is not None:
            found_by_objects = [contender for contender in self.contenders
                                if contender.is_of_objects]
            found_by_objects.sort(key=lambda contender: contender is not best)
            covariance = covariance + spread(
                np.array([contender.pose for contender in found_by_objects]),
                np.array([contender.odds for contender in found_by_objects]))
        return (best.pose, covariance) if by_points is None else fuse(best.pose, covariance,
                                                                      *by_points)

    def evidence(self, covariance: NDArray[np.float64]) -> Evidence:
        """Return the evidence for the leading pose, given its covariance (6, 6)."""
        best, frames = self.by_objects or self.contenders[0], self._joined.frames
        coverage, by_points = coverage_of(frames), self._by_points
        distinct, twin = self._distinct() if len(self.contenders[0].landmarks) else (1.0, None)
        return Evidence(
            round(best.support.inliers), float(self.likely[0]), by_points=by_points,
            rival=self._rival(), distinct=distinct,
            place=place_of(self._joined.landmark_map, self.poses[0]).position,
            twin=twin and twin.position, twin_map=twin.name if twin else '',
            # as in the paper, unrefined poses are not refused for an uncertain position
            near=1.0 if not (self.place or self._by_tags) and best.finalist.information is None
            else float(shares_within(
                RIGHT_M, CALIBRATION.covariance.caution * covariance[None, :3, :3])[0]),
            deviation_m=math.sqrt(np.trace(covariance[:3, :3])), coverage=coverage,
            tried=sum(frame.known_tried for frame in frames),
            # infinite for a search that tried every sample
            meetings=math.inf if self.by_objects is None or (
                coverage == 1.0 and self._joined.options.algorithm in ('auto', 'bf'))
            else meetings_of(frames, best.finalist, best.matches),
            unexplained=best.support.unexplained, signs=self._signs(best), motion=self._motion(),
            not_mirrored=self._not_mirrored(by_points), uncontradicted=self._uncontradicted(),
            recognized=self.place, tags=self._by_tags and self._by_tags.tagged,
            prior=self.contenders[0].prior,
            tilt_deg=tilt_deg(self.poses[0], self._last.base_up_in_camera),
            earlier=self._looks.earlier(self._last, self.poses[0]), crops_left=0
            if self._last.compared is None
            else len(self._last.detections) - len(self._last.compared))

    def _signs(self, best: Contender) -> Signs | None:
        """Return the signs that the leading place is not a picture; None without keyframes there.

        They come from the last frame, because only its image is compared with keyframes.
        """
        if self.place is None:
            return None
        seen, camera = best.matches[-1], self._last.camera
        expected = expect(self._joined.landmark_map, camera, best.pose,
                          np.array([match.landmark for match in seen], dtype=np.int64))
        return signs_of(
            self.place, self._last.detections.bboxes_xyxy[[match.detection for match in seen]],
            camera, max(0.0, min(float((expected.in_sight & ~expected.was_seen).sum()),
                                 best.support.unexplained) - 1.0))

    def _motion(self) -> Motion | None:
        """Compare the motion since an earlier look by keyframes; None without such a look."""
        passed = self._looks.passed(self._last)
        if (self.place is None or self._recognizer is None or passed is None
                or passed[0].recognized is None):
            return None
        return compare_motion(self._recognizer.deviation_per_metre(self.place),
                              passed[0].recognized, self.place, passed[1])

    def _not_mirrored(self, by_points: float) -> float:
        """Return the probability that the image is not mirrored.

        The features of a mirrored image match no keyframe, so a pose that keyframes alone confirm
        is not checked. To save time, a pose that is refused anyway is not checked either. A short
        search of the mirrored image finds the pose if the image is mirrored. The wrong pose is
        then often far from a reflection of it.
        """
        best, options = self.by_objects, self._joined.options
        if (best is None or not options.refine or by_points >= options.min_confidence
                or self.likely[0] < options.min_confidence
                or round(best.support.inliers) < options.min_inliers):
            return 1.0
        terms = CALIBRATION.mirror
        first = [row for row, found in enumerate(best.matches) if found][-int(terms.frames):][0]
        joined = join_frames(self._joined.landmark_map, options, self._joined.frames[first:])
        matches, mirrored = best.matches[first:], _mirrored(joined)
        centers = joined.landmark_map.centers[best._replace(matches=matches).landmarks]
        reflected = [unrefined(pose) for pose in _reflections(centers) @ best.pose @ _FLIP]
        starts = [*find_finalists(mirrored.frames, mirrored.rig, False, MAX_DISTINCT)[
            :int(terms.refined)], max(reflected, key=lambda start: verify_rig(
                mirrored.rig, start.rotation, start.translation).score)]
        found = [mirrored.refined(start) for start in starts]
        supports = mirrored.supports(np.array([pose.map_from_camera for pose in found]),
                                     [matches_of(mirrored.rig, pose) for pose in found])
        own, = utilities([best.support] if len(joined.frames) == len(best.matches)
                         else joined.supports(best.pose[None], [matches]))
        lead = CALIBRATION.attitude.not_mirrored + float(own - utilities(supports).max())
        return 1.0 / (1.0 + math.exp(-max(lead, -50.0)))

    def _uncontradicted(self) -> float:
        """Return the probability that keyframes are wrong if they recognize only other places.

        Only confident recognitions count here. The comparison itself includes the evidence of a
        dozen points.
        """
        chance = max((1.0 / (1.0 + math.exp(-max(points_utility(contender.recognized), -50.0)))
                      for contender in self.contenders if contender.recognized is not None),
                     default=0.0)
        return 1.0 if self.place or chance < self._joined.options.min_confidence else 1.0 - chance

    def _rival(self) -> Rival | None:
        """Return the most likely pose that disagrees with the leading pose."""
        others = np.nonzero(~self.leading)[0]
        if len(others) == 0:
            return None
        row = others[np.argmax(self.likely[others])]
        place = place_of(self._joined.landmark_map, self.poses[row])
        same_source = self.by_objects if self.contenders[row].is_of_objects else \
            self._by_tags if self.contenders[row].tagged else self.place
        return Rival(min(float(self.likely[row]), 1.0 - float(self.likely[0])), place.position,
                     place.name, same_source is None, not self.contenders[row].is_upright,
                     self.contenders[row].tagged)

    @cached_property
    def _by_points(self) -> float:
        """Return the probability of the leading place without the evidence of objects for it."""
        if self.place is None and self._by_tags is None:
            return 0.0
        rows = np.array([row for row, contender in enumerate(self.contenders)
                         if not contender.is_of_objects or not self.leading[row]])
        near = self.leading[rows]
        found = self._confidences(rows, [
            self.contenders[row].by_points if is_near else self.contenders[row].odds
            for row, is_near in zip(rows, near, strict=True)])
        return float(found[near].max())

    def _distinct(self) -> tuple[float, Place | None]:
        """Return the probability that the camera is not at a place that looks alike.

        The second value is the pose of the camera at the most likely of these places; None if
        there is none. Keyframes distinguish a twin as far as they cover it.
        """
        joined, landmark_map = self._joined, self._joined.landmark_map
        best, (low, high) = self.contenders[0], joined.options.height_range_m
        twins, alike = find_twins(landmark_map, best.pose, best.landmarks,
                                  self.poses[~self.leading])
        turned = turned_about_axis(landmark_map, best.pose, best.landmarks)
        found = np.concatenate([twins, turned])
        rooms, copies = (np.append(alike.are_rooms(least), np.zeros(len(turned), dtype=np.bool_))
                         for least in (0.0, CALIBRATION.twins.least_copied))
        inside = np.nonzero((low <= found[:, 2, 3]) & (found[:, 2, 3] <= high))[0]
        places = [joined.refined(unrefined(found[row])) for row in inside]
        poses = np.array([best.pose, *(place.map_from_camera for place in places)])
        # drop the places that refinement moved back to the leading pose
        elsewhere = ~SAME_ANSWER.agreeing(poses)[0]
        # keep the first pose at each place
        before = np.tril(SAME_PLACE.agreeing(poses) & elsewhere, -1)
        others = np.nonzero(elsewhere & ~before.any(axis=1))[0]
        if len(others) == 0:
            return 1.0, None
        rows = inside[others - 1]
        rivals = joined.contenders([places[row - 1] for row in others], [True] * len(others))
        leads = self._leads_of_points(poses[others], copies[rows])
        if self._by_tags is not None and self._by_tags.tagged is not None:
            # a twin with tags of its own is among the contenders
            leads += max(0.0, tags_utility(self._by_tags.tagged))
        for number, (rival, row) in enumerate(zip(rivals, rows, strict=True)):
            if row < len(twins):
                by_objects = lead_over_twin(best.support, rival.support, float(alike.shares[row]),
                                            bool(rooms[row]))
            else:  # the same lead as if the search had found the rival, see confidences
                by_objects = (1.0 + CALIBRATION.objects.slope) * (best.odds - rival.odds)
            leads[number] += best.prior - rival.prior + by_objects
        chance = float(1.0 / (1.0 + np.exp(-np.clip(leads, -50.0, 50.0)).sum()))
        return chance, place_of(landmark_map, poses[others][int(np.argmin(leads))])

    def _leads_of_points(self, twins: NDArray[np.float64], are_rooms: NDArray[np.bool_]
                         ) -> NDArray[np.float64]:
        """Return the log odds (m,) by which keyframes prefer the leading place to each twin.

        They are no evidence against a twin in another room that they do not cover: it may show the
        same points. Between halves of a room with few objects, which are alike by chance, they are
        evidence. The odds are infinite if points alone are enough to accept the leading place
        against the twin: objects have no say then.
        """
        leading = self._by_keyframes
        if self._recognizer is None or self.place is None or leading is None:
            return np.zeros(len(twins))
        covered = np.array([self._recognizer.coverage(pose) for pose in [leading.pose, *twins]])
        known = np.where(are_rooms, np.minimum(1.0, covered[1:] / max(covered[0], 1e-9)), 1.0)
        theirs = np.array([max([0.0] + [
            points_utility(contender.recognized) for contender in self.contenders
            if contender.recognized is not None and SAME_ANSWER.agree(contender.pose, pose)])
            for pose in twins])
        leads = np.maximum(0.0, known * max(0.0, points_utility(self.place)) - theirs)
        is_sure = 1.0 / (1.0 + np.exp(-leads)) >= self._joined.options.min_confidence
        return np.where(is_sure, np.inf, leads)


def _order(contender: Contender) -> tuple[bool, float]:
    return not contender.is_upright, -contender.rank


def _missed(contender: Contender, recognizer: ImageRecognizer) -> Contender:
    """Return a contender that keyframes cover but do not recognize, with lower odds."""
    odds = CALIBRATION.keyframes.missed * recognizer.coverage(contender.pose)
    return contender._replace(odds=contender.odds + odds, by_points=contender.by_points + odds)


def spread(poses: NDArray[np.float64], odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of the differences between a pose and the poses that agree with it.

    The right pose may be missing among the poses found. Their mean square is therefore also added
    in all directions.

    Parameters
    ----------
    poses : ndarray (m, 4, 4)
        map_from_camera. The first pose is compared with all of them.
    odds : ndarray (m,)
        Logarithm of the odds of each pose, up to a constant.

    Returns
    -------
    ndarray (6, 6)
        Mean square of position [m] and rotation about the map's axes [rad].
    """
    agreeing = SAME_ANSWER.agreeing(poses)[0]
    # poses near each other share landmarks and errors, so their odds exaggerate the difference
    weights = np.exp(CALIBRATION.covariance.sharpness * (odds[agreeing] - odds[agreeing].max()))
    turns = Rotation.from_matrix(poses[agreeing, :3, :3] @ poses[0, :3, :3].T).as_rotvec()
    steps = np.concatenate([poses[agreeing, :3, 3] - poses[0, :3, 3], turns], axis=1)
    squares = (steps.T * (weights / weights.sum())) @ steps
    anywhere = np.repeat([np.trace(squares[:3, :3]) / 3, np.trace(squares[3:, 3:]) / 3], 3)
    return np.asarray(squares + np.diag(anywhere))


def _mirrored(joined: JoinedFrames) -> JoinedFrames:
    """Return the frames with their images mirrored left to right, searched with few samples.

    The boxes are mirrored on the plane z = 1, where there is no distortion. The vertical of a
    flipped camera is not mirrored. In front of a mirror, odometry is; a flipped camera that moves
    contradicts its odometry anyway.
    """
    is_auto, frames = joined.options.algorithm == 'auto', []
    options = replace(joined.options, algorithm='auto', refine=False,
                      iterations=int(CALIBRATION.mirror.samples))
    for seen in (frame.observation for frame in joined.frames):
        odom, camera = seen.odom_from_camera, seen.camera
        boxes = camera.normalize_bboxes(seen.detections.bboxes_xyxy)
        frames.append(search_frame(joined.landmark_map, replace(
            seen, odom_from_camera=None if odom is None else _FLIP @ odom @ _FLIP,
            camera=Camera(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0),
            # the paper's algorithms use neither
            depths=seen.depths if is_auto else None,
            up_in_camera=seen.up_in_camera if is_auto else None,
            detections=replace(seen.detections,
                               bboxes_xyxy=boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1))),
            options, NEVER))
    return join_frames(joined.landmark_map, joined.options, frames)


def _reflections(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the reflections (2, 4, 4) in a level plane and in a plane fitted to points (n, 3)."""
    middle = points.mean(axis=0)
    normals = np.array([_UP, np.linalg.svd(points - middle)[2][-1]])
    reflections = np.tile(np.eye(4), (2, 1, 1))
    reflections[:, :3, :3] -= 2.0 * normals[:, :, None] * normals[:, None]
    reflections[:, :3, 3] = 2.0 * (normals @ middle)[:, None] * normals
    return reflections
