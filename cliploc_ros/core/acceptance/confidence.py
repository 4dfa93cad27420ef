# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The evidence for and against poses, and their confidence.

The support of a pose is the evidence of the frames for it and against it. It is weighed against
the support of the other poses.

A conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice Behavior", 1974):
each distinct pose has a utility, linear in its support. The case that no pose is right has a
utility, too: more landmarks in the map let more wrong poses fit by chance, and a known vertical
leaves fewer. Probabilities are proportional to the exponentials of the utilities, so the poses of
an ambiguous scene share the probability. Poses that agree (1 m, 45 degrees) share one sum.

The search of objects chooses its poses among many by their support. Keyframes propose theirs by
points: what the objects say of such a pose counts from the utility of none being right, whatever
the size of the map. Points and objects that lead to one place add up theirs: by chance, features
and boxes do so independently. Where they see one picture, see
cliploc_ros.core.acceptance.genuine.

Where the robot probably is, a region, is evidence, never a cut. A region is right with its
probability p; otherwise the robot may be anywhere in the map. So a pose has the density
p N(pose) + (1 - p) u, where u is uniform over the map. Its logarithm over u is bounded: 0 in the
region, a constant elsewhere. So a region never raises a pose against the case that no pose is
right, and lifts none that its objects support weakly: the confidence of a pose stays below that
without its rivals. Nor does it decide alone between two places that look the same: the robot may
have been told the wrong one of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.depth import depth_errors, depth_odds
from cliploc_ros.core.geometry.ellipsoid import box_ious, project_ellipsoids
from cliploc_ros.core.geometry.transforms import SAME_ANSWER, invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M, LandmarkMap
from cliploc_ros.core.map.similarities import (
    Similarities,
    pair_similarities,
    sampled_spread,
)
from cliploc_ros.core.observation import Detections, Region
from cliploc_ros.core.search.scene import Scene

# No image reaches further [px]: areas stay finite.
_FAR_PX = 1e6


@dataclass(frozen=True)
class Support:
    """The support of a pose; each thing counts once."""

    #: Number of things that are where the map has them: boxes that overlap show one thing
    inliers: float = 0.0
    score: float = 0.0  #: Sum of their IoUs
    #: How far the edges of their boxes are from the outlines: Cauchy's robust sum
    misfit: float = 0.0
    #: How much more similar their crops are to the labels of their landmarks than to the map's
    #: labels on average, in standard deviations, summed
    likeness: float = 0.0
    #: Summed over the objects that have a class of their landmark: the logarithm of the number of
    #: things for each thing of this class, in the map or in any building. A rare class is matched
    #: by chance less often than a common one. A class that the detector takes the landmark for at
    #: times counts by its share, see ClassIndex.shares.
    rarity: float = 0.0
    unlabelled: float = 0.0  #: Number of the objects that were matched by class alone
    #: Number of other detected objects of the map's classes, which no landmark explains
    unexplained: float = 0.0
    #: Log odds of their depths, against those of objects that are somewhere else
    depth: float = 0.0
    _: KW_ONLY
    #: For each detection that shows an object, (frame, row): its share (7,) of inliers, score,
    #: misfit, likeness, rarity, unlabelled and depth
    shown: Mapping[tuple[int, int], NDArray[np.float64]] = field(
        default_factory=dict, compare=False, repr=False)


class ComparedFrame(NamedTuple):
    """A frame to measure supports in: data of its n detections that all poses share."""

    scene: Scene
    classes: NDArray[np.int64]  #: (n,): the map's number of each class
    #: (n,): the logarithm of the number of things for each thing of this class
    rarities: NDArray[np.float64]
    #: (n,): whether the class is a landmark's own, not only a class that it is mistaken for
    are_own: NDArray[np.bool_]
    similarities: Similarities | None  #: None where classes alone are matched
    #: (n,): row of similarities of each detection; -1 where its class alone is matched
    similarity_rows: NDArray[np.int64]
    means: NDArray[np.float64]  #: (n,): of the similarities of each detection
    deviations: NDArray[np.float64]  #: (n,): of the same
    #: (n, n): to what degree two boxes show one thing, 0 to 1, see one_thing
    same: NDArray[np.float64]


def compared_frame(landmark_map: LandmarkMap, detections: Detections, scene: Scene,
                   similarities: Similarities | None, similarity_rows: NDArray[np.int64]
                   ) -> ComparedFrame:
    """Return a frame to measure supports in; see ComparedFrame for the arguments."""
    index = landmark_map.classes
    classes = index.classes_of(detections.class_ids)
    # a class that is rare in the map may be common in the place where the camera is
    common = np.array([CALIBRATION.common.get(name, 0.0) for name in detections.class_ids])
    rarities = -np.log(np.maximum(
        np.maximum(index.sizes_of(classes), 1) / max(len(landmark_map), 1), common))
    means, deviations = np.zeros(len(classes)), np.ones(len(classes))
    compared = similarity_rows >= 0
    if similarities is not None and compared.any():
        means[compared], deviations[compared] = sampled_spread(
            similarities, similarity_rows[compared])
    return ComparedFrame(scene, classes, rarities, index.are_own(classes), similarities,
                         similarity_rows, means, np.maximum(deviations, 1e-6),
                         one_thing(detections.bboxes_xyxy))


def support(landmark_map: LandmarkMap, frames: Sequence[ComparedFrame],
            map_from_cameras: NDArray[np.float64], matches: Sequence[Sequence[Match]]) -> Support:
    """Return the support of a pose in F frames, seen from map_from_cameras (F, 4, 4).

    Several boxes on one landmark count as the best of them, and boxes that overlap share the
    weight of one. So do boxes that no landmark explains; a box of an explained thing does not
    count.
    Frames that show the same object share the error of its shape in the map, so their agreement is
    no more evidence than one of them: the object counts with their mean.
    """
    # by object: maps have duplicates
    rows: dict[int, dict[tuple[int, int], NDArray[np.float64]]] = {}
    unexplained = 0.0
    for number, (frame, map_from_camera, found) in enumerate(zip(
            frames, map_from_cameras, matches, strict=True)):
        best: dict[int, Match] = {}  # of each object
        for match in sorted(found, key=lambda match: -match.iou):
            best.setdefault(int(landmark_map.objects[match.landmark]), match)
        if distinct := [*best.values()]:
            seen = np.array([match.detection for match in distinct])
            weights = 1.0 / frame.same[seen[:, None], seen].sum(axis=1)
            for match, row in zip(distinct, weights[:, None] * _contributions(
                    landmark_map, frame, map_from_camera, distinct), strict=True):
                rows.setdefault(int(landmark_map.objects[match.landmark]), {})[
                    number, match.detection] = row
        # A class that a landmark is only mistaken for does not count: a real person is not
        # expected in a map because a teddy bear sometimes looks like one.
        matched, others = [match.detection for match in found], frame.are_own.copy()
        others[matched] = False
        alone = 1.0 - frame.same[others][:, matched].max(axis=1, initial=0.0)
        unexplained += float((alone / frame.same[others][:, others].sum(axis=1)).sum())
    if not rows:
        return Support()
    shown = {one: row / len(of_object) for of_object in rows.values()
             for one, row in of_object.items()}
    total = np.sum([*shown.values()], axis=0)
    views_of_each = len(shown) / len(rows)
    return Support(*map(float, [*total[:-1], unexplained / views_of_each, total[-1]]),
                   shown=shown)


def _contributions(landmark_map: LandmarkMap, frame: ComparedFrame,
                   map_from_camera: NDArray[np.float64], matches: Sequence[Match]
                   ) -> NDArray[np.float64]:
    """Return the terms of each match (m, 7) in a support."""
    detections = np.array([match.detection for match in matches])
    landmarks = np.array([match.landmark for match in matches])
    rows, likenesses = frame.similarity_rows[detections], np.zeros(len(matches))
    compared = rows >= 0
    if frame.similarities is not None and compared.any():
        likenesses[compared] = pair_similarities(
            frame.similarities, rows[compared], landmarks[compared])
        likenesses = (likenesses - frame.means[detections]) / frame.deviations[detections]
    # 0 if the class of a detection is none of its landmark
    shares = landmark_map.classes.shares(landmarks, frame.classes[detections])
    terms, scene = CALIBRATION.objects, frame.scene
    sigmas = landmark_map.position_sigmas[landmarks]
    centers, shapes = scene.centers[landmarks], scene.shapes[landmarks]
    camera_from_map, odds = invert_transform(map_from_camera), np.zeros(len(matches))
    outlines = project_ellipsoids(camera_from_map, centers, shapes)
    boxes, halves = scene.box_ellipses[detections], np.sqrt(outlines[:, [2, 4]])
    depths = centers @ camera_from_map[2, :3] + camera_from_map[2, 3]
    # the calibration's maps are no worse than the default
    more = np.sqrt(np.maximum(0.0, sigmas ** 2 - DEFAULT_SIGMA_M ** 2)) / depths
    deviations = np.hypot(terms.edge_share * boxes[:, 2:].mean(axis=1) + terms.edge_floor,
                          more)[:, None]
    edges = np.concatenate([outlines[:, :2] - halves - boxes[:, :2] + boxes[:, 2:],
                            outlines[:, :2] + halves - boxes[:, :2] - boxes[:, 2:]], axis=1)
    misfits = np.log1p((edges / deviations) ** 2).sum(axis=1)
    if scene.depths.any():
        odds = depth_odds(depth_errors(
            scene.depths[detections], centers, shapes, sigmas,
            np.ascontiguousarray(camera_from_map[:3, :3]),
            np.ascontiguousarray(camera_from_map[:3, 3])))
    return np.column_stack([
        np.ones(len(matches)), [match.iou for match in matches], misfits, likenesses,
        shares * frame.rarities[detections], ~compared, odds])


def one_thing(bboxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return to what degree each two of n boxes show one thing (n, n), 0 to 1."""
    boxes = np.clip(np.nan_to_num(bboxes_xyxy), -_FAR_PX, _FAR_PX)
    least, most = CALIBRATION.objects.two_things, CALIBRATION.objects.one_thing
    found = np.clip((box_ious(boxes, boxes) - least) / (most - least), 0.0, 1.0)
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


class Setting(NamedTuple):
    """The setting of a pose: with the supports, it determines the chance of a wrong pose."""

    landmarks: int  #: Number of landmarks in the map
    #: Standard deviation of the known vertical [deg]; infinite if none is known
    vertical_deg: float = math.inf

    @property
    def map_size(self) -> float:
        """Return the logarithm of the number of landmarks.

        Boxes may show all things of the building: a small map lacks some that look like its own.
        """
        return math.log(max(CALIBRATION.objects.least_size, self.landmarks))

    @property
    def vertical(self) -> float:
        """Return the log of the attitudes that it rules out: 3.8 to 1 degree, 0 for none."""
        terms = CALIBRATION.objects
        return math.log(terms.vague_vertical_deg / min(
            max(self.vertical_deg, terms.best_vertical_deg), terms.vague_vertical_deg))


def confidences(odds: NDArray[np.float64], poses: NDArray[np.float64], none: float,
                calibration: Calibration = CALIBRATION,
                prior: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the probability (m,) that each pose (m, 4, 4) is within 1 m of the truth.

    The rest to 1 is the probability that another pose is right, or none. Odds (m,) are the
    utilities of the poses, none is that of the case that none of them is right. The prior (m,)
    is log odds of 0 or less, so it raises no pose against none.
    """
    if len(odds) == 0:
        return np.empty(0)
    most = calibration.covariance.most_confidence
    shares = np.exp(np.append(odds, none) - max(odds.max(), none))
    shares = shares[:-1] / shares.sum()
    agreeing = SAME_ANSWER.agreeing(poses)
    likely = np.clip(agreeing @ shares, 1.0 - most, most)
    log_odds = np.log(likely / (1.0 - likely))
    log_odds += calibration.objects.slope * np.maximum(0.0, log_odds - calibration.objects.knee)
    sharpened = 1.0 / (1.0 + np.exp(-log_odds))
    lead = int(np.argmax(likely))
    # the other places lose what the leading place gains
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    if prior is None or not prior.any():
        return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), most)
    # the odds of the prior are no evidence of objects, and not steepened
    kept = np.where(agreeing[lead], sharpened[lead] / likely[lead], lost)
    weighted = shares * kept * np.exp(prior)
    none_of_them = max(0.0, 1.0 - float(shares @ kept))
    return np.minimum(agreeing @ weighted / (weighted.sum() + none_of_them), most)


def utilities(supports: Sequence[Support], calibration: Calibration = CALIBRATION
              ) -> NDArray[np.float64]:
    """Return the utility (m,) of each support by objects: its log odds, up to a constant."""
    terms = calibration.objects
    return np.array([
        terms.score * one.score + terms.misfit * one.misfit + terms.likeness * one.likeness
        + terms.rarity * one.rarity + terms.unlabelled * one.unlabelled
        + terms.unexplained * one.unexplained + terms.depth * one.depth for one in supports])


def none_right(setting: Setting, calibration: Calibration = CALIBRATION) -> float:
    """Return the utility of the case that no pose is right."""
    terms = calibration.objects
    return (terms.none_right + terms.map_size * setting.map_size
            + terms.vertical * setting.vertical)


def counted_points(place: RecognizedPlace, calibration: Calibration = CALIBRATION) -> float:
    """Return how many of the features that agree with a place count, 1 or more."""
    share = calibration.keyframes.thorough if place.is_thorough else 1.0
    return max(1.0, share * place.inliers)


def points_utility(place: RecognizedPlace, calibration: Calibration = CALIBRATION) -> float:
    """Return the evidence of its points for a place: log odds, against a place by chance."""
    terms = calibration.keyframes
    return min(terms.most, terms.none + terms.confirmed * place.confirmed
               + terms.inliers * math.log(counted_points(place, calibration)))


def objects_utility(support: Support, calibration: Calibration = CALIBRATION) -> float:
    """Return the log odds by objects of a pose that keyframes propose, against none."""
    terms = calibration.keyframes
    return (terms.explained * min(terms.most_objects, support.inliers)
            + terms.unexplained * min(terms.most_objects, support.unexplained))


def tilt_handicaps(map_from_cameras: NDArray[np.float64], deviation_deg: float
                   ) -> NDArray[np.float64]:
    """Return the log odds (m,) that the tilt of each camera takes from its pose, 0 to 4.6.

    Parameters
    ----------
    map_from_cameras : ndarray (m, 4, 4)
        Poses in a map whose third axis is up.
    deviation_deg : float
        Standard deviation of the tilt [deg], see RelocalizerOptions; 0 for none.
    """
    if deviation_deg == 0.0:
        return np.zeros(len(map_from_cameras))
    deviation = np.radians(deviation_deg)
    # the optical frame's second axis is down
    tilts = np.arccos(np.clip(-map_from_cameras[:, 2, 1], -1.0, 1.0))
    against = 0.5 * (tilts / deviation) ** 2 - np.log(2.0 / deviation ** 2)
    return np.clip(against, 0.0, CALIBRATION.attitude.wrong_mount)


def region_odds(landmark_map: LandmarkMap, region: Region, poses: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """Return the log odds (m,), 0 or less, that a region gives to camera poses (m, 4, 4) of a map.

    A region of a map that is not there says nothing.
    """
    parts = parts_of(landmark_map)
    shift = next((part.shift for part in parts if part.landmark_map.frame_id == region.frame_id),
                 None)
    if shift is None:
        return np.zeros(len(poses))
    terms = CALIBRATION.prior
    bodies = poses @ region.camera_from_body
    steps = np.c_[bodies[:, :2, 3] - shift[:2], np.arctan2(bodies[:, 1, 0], bodies[:, 0, 0])]
    steps -= region.mean
    steps[:, 2] = (steps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    steps[np.hypot(*bodies[:, :2, 0].T) < terms.least_ahead, 2] = 0.0
    covariance = region.covariance + np.diag(
        [terms.least_m, terms.least_m, math.radians(terms.least_deg)]) ** 2
    spot, yaw = covariance[:2, :2], covariance[2, 2]
    squares = (np.einsum('ni,ij,nj->n', steps[:, :2], np.linalg.inv(spot), steps[:, :2])
               + steps[:, 2] ** 2 / yaw)
    area = sum(float(np.prod(np.ptp(part.landmark_map.centers[:, :2], axis=0)
                             + 2.0 * terms.margin_m)) for part in parts)
    # a region wider than the map is as good as the map
    peak = (max(0.0, math.log(area / (2.0 * math.pi)) - 0.5 * np.linalg.slogdet(spot)[1])
            + max(0.0, 0.5 * math.log(2.0 * math.pi / yaw)))
    p = min(max(region.probability, 1e-9), 1.0 - 1e-9)
    odds = np.logaddexp(math.log(1.0 - p), math.log(p) + peak - 0.5 * squares)
    return np.asarray(np.clip(odds, -terms.most, 0.0))
