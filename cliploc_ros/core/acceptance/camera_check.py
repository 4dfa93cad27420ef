# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check that the boxes of a camera agree with its image, camera_info, mount and the map.

A wrong camera_info, or boxes in the pixels of another image, displace all boxes systematically.
One image hardly shows this error, because the pose adapts to it. Many images show it, because
their poses differ and the error stays the same. A look is the evidence of one frame about the
errors of its camera, with the pose eliminated, see cliploc_ros.core.fit.camera_fit. It consists of
an information matrix and a vector, which add up over looks. Looks from one view share the errors
of their boxes. Their mean therefore counts as one look. Errors of the map do not average out over
views, so many views count as few. Poses that are refused give looks, too, because the few poses
that a wrong camera lets pass fit it well.

A camera is either right, with the small errors of any calibration, or wrong in one of a few ways
(kinds), with large errors. The Bayes factor of wrong against right is a mean of likelihood ratios.
For a right camera, the probability that it ever exceeds N is at most 1 / N, however often it is
computed (Ville, "Etude critique de la notion de collectif", 1939). At odds of 1000, at most one
right camera in 1000 is therefore called wrong, if the looks from different views are independent.
The evidence of a single view is limited to e^3, because its boxes may be matched by mistake.

Until the odds are clear, the confidence of a pose is weighted by the probability that the pose is
right under each kind of error. A pose from a few distant objects needs a camera that looks have
verified. A pose from many objects at different distances does not.

A detector's boxes end at the border of the image that it processed. If many boxes end at one line
inside the image and none extend beyond it, the boxes are in the pixels of another image. This
counts as evidence for some kinds of errors, but at most as e^8, because a border within the image
itself, such as black bars, looks the same. In that case, the looks decide.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, pdtrc

from cliploc_ros.core.acceptance.contenders import JoinedFrames
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.camera_fit import ERRORS, fit_camera
from cliploc_ros.core.fit.covariance import moves_with_cameras, shares_within
from cliploc_ros.core.fit.finalists import Finalist
from cliploc_ros.core.fit.refinement import one_to_one
from cliploc_ros.core.fit.verification import camera_pose, verify_rig
from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import box_ious
from cliploc_ros.core.observation import Observation

_TERMS = CALIBRATION.camera
# Standard deviations of the errors of a right camera and of a wrong one, see camera_fit.
_RIGHT = np.array([_TERMS.focal, _TERMS.aspect, _TERMS.point, _TERMS.point, _TERMS.corner,
                   _TERMS.corner, _TERMS.size])
#: Standard deviations of the errors of a right camera_info.
CALIBRATED = np.where(np.arange(ERRORS) < 4, _TERMS.calibrated * _RIGHT, 0.0)
_WRONG = np.array([_TERMS.wrong_focal, _TERMS.wrong_aspect, _TERMS.wrong_point, _TERMS.wrong_point,
                   _TERMS.wrong_corner, _TERMS.wrong_corner, _TERMS.wrong_size])
# The errors that are large in each kind of wrong camera. The others are as small as for a right
# camera.
_KINDS = {'image': (0, 2, 3), 'focal length': (0,), 'aspect': (1,), 'principal point': (2, 3),
          'stretched image': (0, 1, 2, 3), 'convention': (4, 5), 'size': (6,)}
_OF_OTHER_PIXELS = np.isin([*_KINDS], ['image', 'principal point', 'stretched image'])
_UNKNOWN_INFO = 1 + list(_KINDS).index('stretched image')
_DEVIATIONS = np.array([_RIGHT, *(np.where(np.isin(np.arange(ERRORS), errors), _WRONG, _RIGHT)
                                  for errors in _KINDS.values())])
_LOG_DEVIATIONS = np.log(_DEVIATIONS).sum(axis=1)
_WEIGHTS = np.array([1.0 - _TERMS.wrong, *(_TERMS.wrong * (
    _TERMS.focal_share if kind == 'focal length' else
    (1.0 - _TERMS.focal_share) / (len(_KINDS) - 1)) for kind in _KINDS)])
_PRIORS = _DEVIATIONS[:, :, None] ** -2.0 * np.eye(ERRORS)
# Limits of the numbers and of the mean errors of a recorded state. A file with larger ones is
# damaged.
_FAR, _LARGE = 1e12, 100.0


class CameraLook(NamedTuple):
    """The evidence of a frame about the errors of its camera."""

    camera_name: str
    is_new: bool  #: Whether the frame belongs to the newest instant
    map_from_camera: NDArray[np.float64]  #: (4, 4)
    #: (7, 7), (7,): information matrix of the errors; its product with the most likely errors
    information: NDArray[np.float64]
    vector: NDArray[np.float64]
    #: By what factor the information is smaller if the residuals are errors of the boxes
    careful: float
    #: (6, 7): how the pose of the newest camera moves with each error [m] [rad]
    moves: NDArray[np.float64]


def _log_mean(logs: NDArray[np.float64]) -> float:
    """Return the logarithm of the mean of numbers, given their logarithms (n,)."""
    most = float(logs.max())
    return most + math.log(float(np.exp(logs - most).mean()))


class CameraOdds(NamedTuple):
    """The odds of 1 + k hypotheses: the camera is right, or wrong in one of k ways."""

    odds: NDArray[np.float64]  #: (1 + k,): log likelihood of each hypothesis, up to a constant
    means: NDArray[np.float64]  #: (1 + k, 7): mean errors under each hypothesis
    squares: NDArray[np.float64]  #: (1 + k, 7, 7): second moments of the errors

    @property
    def log_odds(self) -> float:
        """Return the logarithm of the Bayes factor of a wrong camera against a right one."""
        return _log_mean(self.odds[1:]) - float(self.odds[0])

    @property
    def is_wrong(self) -> bool:
        """Return whether the camera is certainly wrong."""
        return self.log_odds > _TERMS.sure

    def effect(self, covariance: NDArray[np.float64], moves: NDArray[np.float64]
               ) -> tuple[float, NDArray[np.float64]]:
        """Return the effect of the errors of a possibly wrong camera on a pose.

        Parameters
        ----------
        covariance : ndarray (6, 6)
            Covariance of the pose if the camera is right.
        moves : ndarray (6, 7)
            See CameraLook.

        Returns
        -------
        float
            By what factor these errors lower the probability that the pose is within 1 m.
        ndarray (6, 6)
            What they add to the covariance: the errors of camera_info, weighted by the
            probability that the camera is wrong. Its kind does not matter, since few looks tell
            the kinds apart.
        """
        weights = np.exp(self.odds - self.odds.max()) * _WEIGHTS
        weights /= weights.sum()
        added = moves @ self.squares @ moves.T
        added[0] = 0.0  # the covariance includes the errors of a right camera
        near = shares_within(transforms.RIGHT_M, (CALIBRATION.covariance.caution * covariance
                                                  + added)[:, :3, :3])
        mean, square = self.means[_UNKNOWN_INFO, 0], self.squares[_UNKNOWN_INFO]
        variance = square[0, 0] - mean**2
        # all distances grow by a factor, whose logarithm is the error of the focal length
        grown = np.exp(min(2.0 * (mean + variance), _LARGE)) - 2.0 * np.exp(
            mean + variance / 2.0) + 1.0
        moves = moves * [math.sqrt(grown / square[0, 0]), *[1.0] * (ERRORS - 1)]
        return float(weights @ near / near[0]), (1.0 - weights[0]) * (moves @ square @ moves.T)


def odds_of(information: NDArray[np.float64], vector: NDArray[np.float64], extent: float = 0.0
            ) -> CameraOdds:
    """Return the odds of a camera from its looks.

    Parameters
    ----------
    information, vector : ndarray (7, 7), (7,)
        Sums of information and vector over the looks, see CameraLook.
    extent : float
        Log odds, from the extent of the boxes, that they are in the pixels of another image.
    """
    covariances = np.linalg.inv(information + _PRIORS)
    means = covariances @ vector
    odds = 0.5 * (np.log(np.linalg.det(covariances)) + means @ vector) - _LOG_DEVIATIONS
    odds[1:] += extent * _OF_OTHER_PIXELS
    return CameraOdds(odds, means, covariances + means[:, :, None] * means[:, None])


def looks_of(joined: JoinedFrames, pose: Finalist) -> list[CameraLook]:
    """Return the look of each frame at its camera, given the pose of the last frame.

    Frames with too few matches give no look.
    """
    inliers = one_to_one(joined.rig, verify_rig(joined.rig, pose.rotation, pose.translation),
                         pose.rotation, pose.translation)
    looks, last = [], joined.frames[-1].observation
    moves = moves_with_cameras(joined.rig, inliers, pose.rotation, pose.translation)
    names = np.array([frame.observation.camera_name for frame in joined.frames])
    for number, frame in enumerate(joined.frames):
        pairs = inliers.pairs[inliers.starts[number]:inliers.starts[number + 1]]
        vertical, seen = joined.rig.verticals[number], frame.observation
        if len(pairs) < (2 if vertical[6] > 0.0 else 3):
            continue
        rotation, translation = camera_pose(joined.rig.cameras[number], pose.rotation,
                                            pose.translation)
        rows = (frame.scene.box_ellipses == pairs[:, None, :4]).all(axis=2).argmax(axis=1)
        low = _TERMS.border_px
        high = np.array([seen.camera.width, seen.camera.height]) - low
        left, top, right, bottom = seen.detections.bboxes_xyxy[rows].T
        is_edge = np.stack([left > low, right < high[0], top > low, bottom < high[1]], axis=1)
        fit = fit_camera(pairs, is_edge, vertical, rotation, translation, _WRONG)
        vector = fit.information @ fit.errors + fit.errors / _WRONG ** 2
        if not np.isfinite([*fit.information.ravel(), *vector]).all():
            continue  # NaN or infinity would corrupt the sum over all later looks
        noise = max(1.0, (fit.square + _TERMS.prior_square * _TERMS.prior_residuals)
                    / (max(0, int(is_edge.sum()) - 6 - ERRORS) + _TERMS.prior_residuals))
        weight = _limit(fit.information, vector)
        careful = _limit(fit.information / noise, vector / noise) / noise
        looks.append(CameraLook(
            seen.camera_name, seen.stamp_ns == last.stamp_ns,
            transforms.invert_transform(transforms.make_transform(rotation, translation)),
            weight * fit.information, weight * vector, careful / weight,
            moves[names == seen.camera_name].sum(axis=0)))
    return looks


def _limit(information: NDArray[np.float64], vector: NDArray[np.float64]) -> float:
    """Return the weight of a look with which its log odds are at most those of a view."""
    return _TERMS.view / max(_TERMS.view, odds_of(information, vector).log_odds)


class Views(NamedTuple):
    """The looks of a camera from v views, as the mean of the looks from each view."""

    poses: NDArray[np.float64] = np.empty((0, 4, 4))  #: (v, 4, 4): map_from_camera
    counts: NDArray[np.int64] = np.empty(0, dtype=np.int64)  #: (v,): number of looks
    informations: NDArray[np.float64] = np.empty((0, ERRORS, ERRORS))  #: (v, 7, 7)
    vectors: NDArray[np.float64] = np.empty((0, ERRORS))  #: (v, 7)
    careful: NDArray[np.float64] = np.empty(0)  #: (v,)

    def with_look(self, look: CameraLook) -> 'Views':
        """Return these views with a look added; the oldest views are dropped if too many."""
        same = np.nonzero(transforms.SAME_BOXES.agreeing(
            self.poses, look.map_from_camera[None])[:, 0])[0]
        if not len(same):
            new = (look.map_from_camera, 1, look.information, look.vector, look.careful)
            return self.joined(Views(*(np.array([field]) for field in new)))
        counts = self.counts + (np.arange(len(self.counts)) == same[0])
        share = (counts - self.counts) / counts
        return Views(self.poses, counts, self.informations + share[:, None, None] * (
            look.information - self.informations), self.vectors + share[:, None] * (
                look.vector - self.vectors), self.careful + share * (look.careful - self.careful))

    def joined(self, other: 'Views') -> 'Views':
        """Return these views followed by others; the oldest views are dropped if too many."""
        return Views(*(np.concatenate(both)[-int(_TERMS.most_views):]
                       for both in zip(self, other, strict=True)))

    @property
    def sums(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the sums of information (7, 7) and vector (7,) over the views."""
        return self.informations.sum(axis=0), self.vectors.sum(axis=0)

    def odds(self, extent: float = 0.0) -> CameraOdds:
        """Return the odds of the camera from all looks; for extent see odds_of."""
        share = min(1.0, _TERMS.independent / max(1, len(self.poses)))
        information, vector = self.sums
        return odds_of(share * information, share * vector, extent)

    def careful_odds(self, extent: float = 0.0) -> CameraOdds:
        """Return the odds for the confidence of a pose, which poor fits hardly change."""
        return self._replace(
            informations=self.careful[:, None, None] * self.informations,
            vectors=self.careful[:, None] * self.vectors).odds(extent)

    @property
    def are_right(self) -> bool:
        """Return whether the looks verify the camera, also without those of any one place."""
        return self.odds().log_odds < _TERMS.fits and all(
            Views(*(part[~near] for part in self)).odds().log_odds < _TERMS.fits
            for near in transforms.SAME_PLACE.agreeing(self.poses))


class Extent(NamedTuple):
    """The area that the boxes of a camera cover, over accepted and refused frames."""

    boxes: NDArray[np.float64] = np.empty((0, 4))  #: (n, 4) [px]

    def with_boxes(self, boxes: NDArray[np.float64]) -> 'Extent':
        """Return this area with the boxes (n, 4) of a frame, without boxes seen before."""
        is_known = (box_ious(boxes, self.boxes) > _TERMS.same_box).any(axis=1)
        return Extent(np.concatenate([self.boxes, boxes[~is_known]])[-int(_TERMS.most_boxes):])

    def log_odds(self, camera: Camera) -> float:
        """Return the log odds, at least 0, that the boxes are in the pixels of another image."""
        count, size = len(self.boxes), np.array([camera.width, camera.height])
        if not count:
            return 0.0
        # how far each box extends to the right, down, left and up
        reaches = np.hstack([self.boxes[:, 2:], size - self.boxes[:, :2]])
        lines, lengths = reaches.max(axis=0), np.tile(size, 2)
        # how many other boxes end at the same line; density of the boxes that end near it
        ends = (reaches > lines - _TERMS.border_px).sum(axis=0) - 1
        near = (reaches > lines - _TERMS.near_share * lengths).sum(axis=0) - ends
        density = np.maximum(_TERMS.least_density * count, near / _TERMS.near_share) / lengths
        is_line = (lines < (1.0 - _TERMS.inside) * lengths) & (ends > 0)
        middles = (self.boxes[:, :2] + self.boxes[:, 2:]) / 2
        beyond = int(((middles < 0.0) | (middles > size)).any(axis=1).sum())
        chances = [*np.where(is_line, pdtrc(ends - 1, _TERMS.border_px * density), 1.0),
                   float(bdtrc(beyond - 1, count, _TERMS.beyond)) if beyond else 1.0]
        # a p-value p is evidence of at most 1 / (2 sqrt(p)) (Vovk and Wang 2021)
        evidence = _log_mean(-0.5 * np.log(np.maximum(chances, 1e-99))) - math.log(2.0)
        return float(np.clip(evidence, 0.0, _TERMS.extent))


class _Record:
    """The evidence about one camera."""

    def __init__(self, name: str, camera: Camera) -> None:
        self.name, self.camera = name, camera
        self.views, self.since, self.extent = Views(), Views(), Extent()
        self.by_extent = 0.0  # log odds that the camera is wrong
        self.odds = self.by_looks = self.views.odds()  # from looks and extent; from looks alone

    def see(self, observation: Observation) -> None:
        """Add the boxes of a frame, unless looks have verified the camera."""
        if self.by_looks.log_odds > _TERMS.fits or self.by_extent > 0.0:
            self.extent = self.extent.with_boxes(observation.detections.bboxes_xyxy)
            self.by_extent = self.extent.log_odds(self.camera)
            self.odds = self.views.odds(self.by_extent)

    def add(self, look: CameraLook) -> None:
        """Add a look. After a verdict "wrong", new looks decide whether the camera is repaired."""
        if not self.by_looks.is_wrong:
            self.views, self.since = self.views.with_look(look), Views()
        else:
            self.since = self.since.with_look(look)
            # by how much the looks since the verdict raise the odds of the same errors
            gain = (odds_of(*self.views.joined(self.since).sums).log_odds
                    - odds_of(*self.views.sums).log_odds)
            if gain > _TERMS.view:
                self.views, self.since = self.views.joined(self.since), Views()
            elif (gain < -_TERMS.view and self.since.are_right and self.by_extent < -_TERMS.fits):
                self.views, self.since = self.since, Views()
        self.odds, self.by_looks = self.views.odds(self.by_extent), self.views.odds()

    def fields(self) -> dict[str, Any]:
        """Return the state as lists and numbers."""
        return {'camera': asdict(self.camera), 'boxes': self.extent.boxes.tolist(),
                **{name: [part.tolist() for part in getattr(self, name)]
                   for name in ('views', 'since')}}

    @classmethod
    def of_fields(cls, name: str, fields: Mapping[str, Any]) -> '_Record':
        """Restore a state; KeyError, TypeError or ValueError if `fields` are damaged."""
        camera = dict(fields['camera'])
        record = cls(name, Camera(**camera | {'distortion': tuple(camera['distortion'])}))
        boxes = fields['boxes']
        record.extent = Extent(np.array(boxes, dtype=np.float64).reshape(len(boxes), 4))
        record.views, record.since = (Views._make(
            np.array(part, dtype=empty.dtype).reshape(len(part), *empty.shape[1:])
            for part, empty in zip(
                # earlier releases did not weigh looks
                parts if len(parts) > 4 else [*parts, [1.0] * len(parts[1])],
                Views(), strict=True)) for parts in (fields['views'], fields['since']))
        for views in (record.views, record.since):
            # LinAlgError, a ValueError: it is no information matrix, up to rounding
            np.linalg.cholesky(views.informations + 0.01 * np.diag(_WRONG ** -2.0))
            if len({*map(len, views)}) > 1 or len(views.poses) > _TERMS.most_views or not all(
                    (np.abs(part) < _FAR).all() for part in (*views, record.extent.boxes)) or (
                    np.minimum(views.counts, views.careful) <= 0.0).any() or (
                    np.abs(views.odds().means) >= _LARGE).any():
                raise ValueError('views have different lengths, invalid numbers, or are too many')
        record.by_extent = record.extent.log_odds(record.camera)
        record.odds, record.by_looks = record.views.odds(record.by_extent), record.views.odds()
        return record

    def in_words(self, odds: CameraOdds) -> str:
        """Describe the errors of a wrong camera in one line."""
        row = 1 + int(np.argmax(odds.odds[1:]))
        kind, (focal, aspect, *shift, across, along, size) = list(_KINDS)[row - 1], odds.means[row]
        camera, where = self.camera, f'{self.name}: ' if self.name else ''
        if self.by_extent > _TERMS.view and _OF_OTHER_PIXELS[row - 1]:
            left, top = self.extent.boxes[:, :2].min(axis=0)
            right, bottom = self.extent.boxes[:, 2:].max(axis=0)
            return (f'{where}boxes reach from ({left:.0f}, {top:.0f}) to ({right:.0f}, '
                    f'{bottom:.0f}) of {camera.width} x {camera.height} px')
        if kind == 'convention':
            return (f'{where}boxes are off by {across:+.2f} of their widths and {along:+.2f} of '
                    'their heights')
        if kind == 'size':
            return f'{where}boxes are {math.exp(size):.2f} times as large as those of the map'
        fx = camera.fx * math.exp(focal + aspect / 2)
        fy = camera.fy * math.exp(focal - aspect / 2)
        cx, cy = camera.cx + camera.fx * shift[0], camera.cy + camera.fy * shift[1]
        return (f'{where}boxes fit fx {fx:.0f} fy {fy:.0f} cx {cx:.0f} cy {cy:.0f} px, not '
                f'{camera.fx:.0f} {camera.fy:.0f} {camera.cx:.0f} {camera.cy:.0f}')


class CameraCheck:
    """The evidence of a localizer's looks about its cameras, by camera name."""

    def __init__(self) -> None:
        self._records: dict[str, _Record] = {}
        self._instants: deque[dict[str, tuple[int, int]]] = deque(maxlen=int(_TERMS.most_instants))

    def copied(self) -> 'CameraCheck':
        """Return a copy that later looks do not change."""
        same = CameraCheck()  # views and boxes are shared, as they are never modified
        same._records = {name: copy(record) for name, record in self._records.copy().items()}
        return same

    def fields(self) -> dict[str, Any]:
        """Return the state that affects poses as lists and numbers, to be stored in a file."""
        return {name: record.fields() for name, record in self._records.items()}

    @classmethod
    def of_fields(cls, fields: Mapping[str, Any]) -> 'CameraCheck':
        """Restore a state; KeyError, TypeError or ValueError if `fields` are damaged."""
        check = cls()
        check._records = {name: _Record.of_fields(name, field) for name, field in fields.items()}
        return check

    def see(self, observation: Observation) -> None:
        """Add the boxes of an accepted or refused frame; a new camera_info resets the evidence."""
        name, camera = observation.camera_name, observation.camera
        record = self._records.get(name)
        if record is None or not _is_same(record.camera, camera):
            record = self._records[name] = _Record(name, camera)
        record.see(observation)

    def add(self, looks: Sequence[CameraLook]) -> None:
        """Add the looks of a pose that is likely right, accepted or not."""
        for look in looks:
            if look.is_new:
                self._records[look.camera_name].add(look)

    def judge(self, looks: Sequence[CameraLook], covariance: NDArray[np.float64]
              ) -> tuple[float, NDArray[np.float64], str]:
        """Return the effect of camera errors on a pose, without adding its looks.

        The effect is the factor and the covariance (6, 6) with the errors of its cameras, see
        CameraOdds.effect, and a description of what is very likely wrong with a camera, empty if
        nothing is. The given covariance is that of the pose if its cameras are right.
        """
        share, wider, fault = 1.0, covariance, ''
        for name in dict.fromkeys(look.camera_name for look in looks):
            its_looks = [look for look in looks if look.camera_name == name]
            record = self._records.get(name)
            views = reduce(Views.with_look, its_looks, record.views if record else Views())
            extent = record.by_extent if record else 0.0
            odds, moves = views.odds(extent), its_looks[-1].moves
            near, added = views.careful_odds(extent).effect(covariance, moves)
            share = min(share, near, odds.effect(covariance, moves)[0])
            wider = wider + added
            if record is not None and odds.log_odds > _TERMS.doubted:
                fault = record.in_words(odds)
        return share, wider, fault or '; '.join(self.faults)

    @property
    def faults(self) -> list[str]:
        """Return a description of each camera that is certainly wrong."""
        return [record.in_words(record.odds) for record in self._records.copy().values()
                if record.odds.is_wrong]

    @property
    def values(self) -> dict[str, str]:
        """Return the log odds that each camera is wrong, as text for the diagnostics."""
        return {f'camera check {name}'.rstrip():
                f'{record.odds.log_odds:+.1f} log odds that boxes or camera_info are wrong, by '
                f'{len(record.views.poses)} views'
                for name, record in self._records.copy().items()}

    def add_instant(self, seen: Sequence[Observation], known: Sequence[int],
                    matched: Sequence[int]) -> None:
        """Add an accepted pose.

        Parameters
        ----------
        seen : sequence of Observation
            The frame of each camera.
        known, matched : sequence of int
            Numbers of detections of the map's classes, and of matches, in each frame.
        """
        self._instants.append({frame.camera_name: (of_map, found) for frame, of_map, found
                               in zip(seen, known, matched, strict=True)})

    @property
    def wrong_mounts(self) -> list[str]:
        """Return the names of the cameras whose mount cannot be right."""
        names = dict.fromkeys(name for instant in self._instants for name in instant)
        counts = {name: np.array([instant[name] for instant in self._instants if name in instant])
                  for name in names}
        every = np.sum([of_camera.sum(axis=0) for of_camera in counts.values()], axis=0)
        found = []
        for name, of_camera in counts.items():
            known, matched = of_camera.sum(axis=0)
            others_known, others_matched = every - (known, matched)
            if (len(of_camera) >= _TERMS.mount_instants and min(known, others_known)
                    >= _TERMS.mount_objects and matched < _TERMS.mount_share * known
                    and matched / known < _TERMS.mount_others * others_matched / others_known):
                found.append(name)
        return found


def _is_same(one: Camera, other: Camera) -> bool:
    """Return whether two cameras differ at most by the intrinsics that an autofocus changes."""
    changes = np.array([one.fx, one.fy, one.cx, one.cy]) - [other.fx, other.fy, other.cx, other.cy]
    return bool(np.abs(changes).max() <= _TERMS.same_info * one.fx) and one == replace(
        other, fx=one.fx, fy=one.fy, cx=one.cx, cy=one.cy)
