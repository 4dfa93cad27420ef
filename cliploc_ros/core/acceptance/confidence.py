# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The evidence for and against poses, and their confidence.

The support of a pose is the evidence of the frames for and against it. It is weighed against the
support of the other poses.

The model is a conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice
Behavior", 1974). Each distinct pose has a utility, which is linear in its support. The case that
no pose is right has a utility, too: the more landmarks a map has, the more wrong poses fit by
chance, and a known vertical excludes some of them. Probabilities are proportional to the
exponentials of the utilities, so the poses of an ambiguous scene share the probability. The
probabilities of poses that agree (1 m, 45 degrees) are added.

The search of objects selects its poses from many by their support. Keyframes propose poses from
matched points instead. The evidence of objects for such a pose is added to the utility of the case
that no pose is right, whatever the size of the map. If points and objects lead to one place, their
evidence is added, because chance agreements of features and of boxes are independent. The
exception is a picture that shows both, see cliploc_ros.core.acceptance.genuine.

A prior region, where the robot probably is, counts as evidence and excludes no pose. The region is
right with probability p; otherwise the robot may be anywhere in the map. A pose therefore has the
density p N(pose) + (1 - p) u, where u is uniform over the map. The logarithm of this density over
u is limited: it is 0 in the region and a negative constant far from it. A region therefore never
raises a pose against the case that no pose is right. It does not help a pose that its objects
support weakly either: the confidence of the pose stays below its confidence without rivals. A
region alone does not decide between two places that look the same, because it may be that of the
wrong place.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.fit.tag_pose import TagPlace
from cliploc_ros.core.geometry.depth import depth_errors, depth_odds
from cliploc_ros.core.geometry.ellipsoid import box_ious, project_ellipsoids
from cliploc_ros.core.geometry.transforms import SAME_ANSWER, invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M, LandmarkMap
from cliploc_ros.core.map.similarities import Similarities, pair_similarities, sampled_spread
from cliploc_ros.core.observation import Observation, Region
from cliploc_ros.core.search.scene import Scene

# Box coordinates are clipped to this, so that areas stay finite [px].
_FAR_PX = 1e6


@dataclass(frozen=True)
class Support:
    """The support of a pose; each object counts once."""

    #: Number of matched objects. Boxes that overlap count as one object.
    inliers: float = 0.0
    score: float = 0.0  #: Sum of the IoUs of the matched objects
    #: Sum of Cauchy's losses of the distances from the edges of their boxes to the outlines
    misfit: float = 0.0
    #: How much more similar their crops are to the labels of their landmarks than to the map's
    #: labels on average, in standard deviations, summed
    likeness: float = 0.0
    #: Sum of the rarities of the matched classes. The rarity is minus the logarithm of the share
    #: of a class among all objects of the map or of any building. A rare class is matched by
    #: chance less often than a common one. A class that the detector sometimes mistakes the
    #: landmark for counts by its share, see ClassIndex.shares.
    rarity: float = 0.0
    unlabelled: float = 0.0  #: Number of objects that were matched by class alone
    #: Number of detected objects of the map's classes that no landmark explains
    unexplained: float = 0.0
    #: Log odds of the depths of the matched objects, against depths of wrong matches
    depth: float = 0.0
    _: KW_ONLY
    group: float = 0.0  #: Log odds against a pose that matches one small group, see _of_group
    #: For each matched detection, (frame, row): its share (7,) of inliers, score, misfit,
    #: likeness, rarity, unlabelled and depth
    shown: Mapping[tuple[int, int], NDArray[np.float64]] = field(
        default_factory=dict, compare=False, repr=False)


class ComparedFrame(NamedTuple):
    """A frame and the data of its n detections that the supports of all poses need."""

    scene: Scene
    classes: NDArray[np.int64]  #: (n,): the map's number of the class of each detection
    #: (n,): minus the logarithm of the share of each detection's class, see Support.rarity
    rarities: NDArray[np.float64]
    #: (n,): whether the map has landmarks of the class, not only landmarks mistaken for it
    are_own: NDArray[np.bool_]
    similarities: Similarities | None  #: None if detections are matched by class alone
    #: (n,): row of similarities of each detection; -1 if it is matched by class alone
    similarity_rows: NDArray[np.int64]
    means: NDArray[np.float64]  #: (n,): mean of the similarities of each detection
    deviations: NDArray[np.float64]  #: (n,): standard deviation of these similarities
    #: (n, n): to what degree two boxes show the same object, 0 to 1, see one_thing
    same: NDArray[np.float64]


def compared_frame(landmark_map: LandmarkMap, scene: Scene, seen: Observation) -> ComparedFrame:
    """Compute the data of a frame that supports need; see ComparedFrame for the arguments."""
    index, class_ids, rows = landmark_map.classes, seen.detections.class_ids, seen.similarity_rows
    classes = index.classes_of(class_ids)
    # a class that is rare in the map may be common in the place where the camera is
    common = np.array([CALIBRATION.common.get(name, 0.0) for name in class_ids])
    rarities = -np.log(np.maximum(
        np.maximum(index.sizes_of(classes), 1) / max(len(landmark_map), 1), common))
    means, deviations = np.zeros(len(classes)), np.ones(len(classes))
    compared = rows >= 0
    if seen.similarities is not None and compared.any():
        means[compared], deviations[compared] = sampled_spread(seen.similarities, rows[compared])
    return ComparedFrame(scene, classes, rarities, index.are_own(classes), seen.similarities, rows,
                         means, np.maximum(deviations, 1e-6),
                         one_thing(seen.detections.bboxes_xyxy))


def support(landmark_map: LandmarkMap, frames: Sequence[ComparedFrame],
            map_from_cameras: NDArray[np.float64], matches: Sequence[Sequence[Match]]) -> Support:
    """Return the support of a pose in F frames with cameras at map_from_cameras (F, 4, 4).

    Of several boxes on one landmark, the best one counts. Boxes that overlap share the weight of
    one box. The same holds for boxes that no landmark explains, but those that show a matched
    object do not count as unexplained.

    Frames that show the same object share the error of its shape in the map. Several such frames
    are no more evidence than one frame, so the object counts with their mean.
    """
    # for each object, as maps have duplicate landmarks
    rows: dict[int, dict[tuple[int, int], NDArray[np.float64]]] = {}
    unexplained = 0.0
    for number, (frame, map_from_camera, found) in enumerate(zip(
            frames, map_from_cameras, matches, strict=True)):
        best: dict[int, Match] = {}  # the best match of each object
        for match in sorted(found, key=lambda match: -match.iou):
            best.setdefault(int(landmark_map.objects[match.landmark]), match)
        if distinct := [*best.values()]:
            seen = np.array([match.detection for match in distinct])
            weights = 1.0 / frame.same[seen[:, None], seen].sum(axis=1)
            for match, row in zip(distinct, weights[:, None] * _contributions(
                    landmark_map, frame, map_from_camera, distinct), strict=True):
                rows.setdefault(int(landmark_map.objects[match.landmark]), {})[
                    number, match.detection] = row
        # A class that landmarks are only mistaken for does not count as unexplained: people are
        # not expected in a map just because a teddy bear sometimes looks like a person.
        matched, others = [match.detection for match in found], frame.are_own.copy()
        others[matched] = False
        alone = 1.0 - frame.same[others][:, matched].max(axis=1, initial=0.0)
        unexplained += float((alone / frame.same[others][:, others].sum(axis=1)).sum())
    if not rows:
        return Support()
    shown = {detection: row / len(of_object) for of_object in rows.values()
             for detection, row in of_object.items()}
    total = np.sum([*shown.values()], axis=0)
    views_of_each = len(shown) / len(rows)
    centers = landmark_map.centers[[match.landmark for found in matches for match in found]]
    return Support(*map(float, [*total[:-1], unexplained / views_of_each, total[-1]]),
                   group=_of_group(centers, *total[[0, 2]]), shown=shown)


def _of_group(centers: NDArray[np.float64], inliers: float, misfit: float) -> float:
    """Return the log odds against a pose whose matched landmarks (n, 3) are one small group.

    Desks look like desks: the image may show things that the map lacks, arranged like a mapped
    group. The map does not tell how many such groups there are. Their boxes fit less well than
    those of the mapped group, so the odds grow with the misfit. More objects than four, or an
    object elsewhere in the room, tell groups apart.
    """
    terms = CALIBRATION.group
    # scipy's pdist would take a tenth of the time of a support
    if inliers >= terms.large or np.linalg.norm(
            centers[:, None] - centers, axis=2).max(initial=0.0) > terms.extent_m:
        return 0.0
    share = np.interp(inliers, (terms.small, terms.large), (1.0, 0.0))
    return float(share * (terms.unmapped + terms.misfit * max(0.0, misfit - terms.fits * inliers)))


def _contributions(landmark_map: LandmarkMap, frame: ComparedFrame,
                   map_from_camera: NDArray[np.float64], matches: Sequence[Match]
                   ) -> NDArray[np.float64]:
    """Return the contribution (m, 7) of each match to the support, see Support.shown."""
    detections = np.array([match.detection for match in matches])
    landmarks = np.array([match.landmark for match in matches])
    rows, likenesses = frame.similarity_rows[detections], np.zeros(len(matches))
    compared = rows >= 0
    if frame.similarities is not None and compared.any():
        likenesses[compared] = pair_similarities(
            frame.similarities, rows[compared], landmarks[compared])
        likenesses = (likenesses - frame.means[detections]) / frame.deviations[detections]
    # 0 if the landmark is never detected as this class
    shares = landmark_map.classes.shares(landmarks, frame.classes[detections])
    terms, scene = CALIBRATION.objects, frame.scene
    sigmas = landmark_map.position_sigmas[landmarks]
    centers, shapes = scene.centers[landmarks], scene.shapes[landmarks]
    camera_from_map, odds = invert_transform(map_from_camera), np.zeros(len(matches))
    outlines = project_ellipsoids(camera_from_map, centers, shapes)
    boxes, halves = scene.box_ellipses[detections], np.sqrt(outlines[:, [2, 4]])
    depths = centers @ camera_from_map[2, :3] + camera_from_map[2, 3]
    # the deviations were calibrated on maps with the default sigma
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
    """Return to what degree each pair of n boxes shows the same object (n, n), 0 to 1."""
    boxes = np.clip(np.nan_to_num(bboxes_xyxy), -_FAR_PX, _FAR_PX)
    least, most = CALIBRATION.objects.two_things, CALIBRATION.objects.one_thing
    found = np.clip((box_ious(boxes, boxes) - least) / (most - least), 0.0, 1.0)
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


class Setting(NamedTuple):
    """The conditions that, with the supports, determine the probability of a wrong pose."""

    landmarks: int  #: Number of landmarks in the map
    #: Standard deviation of the known vertical [deg]; infinite if it is unknown
    vertical_deg: float = math.inf

    @property
    def map_size(self) -> float:
        """Return the logarithm of the number of landmarks, limited below by least_size.

        Boxes may show any object of the building, and a small map lacks many that look like its
        landmarks.
        """
        return math.log(max(CALIBRATION.objects.least_size, self.landmarks))

    @property
    def vertical(self) -> float:
        """Return the log ratio of vague to known deviation: 3.8 at 1 degree, 0 if unknown."""
        terms = CALIBRATION.objects
        return math.log(terms.vague_vertical_deg / min(
            max(self.vertical_deg, terms.best_vertical_deg), terms.vague_vertical_deg))


def confidences(odds: NDArray[np.float64], poses: NDArray[np.float64], none: float,
                calibration: Calibration = CALIBRATION,
                prior: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the probability (m,) that each pose (m, 4, 4) is within 1 m of the truth.

    The probability that another pose, or none of them, is right makes up the difference to 1. Odds
    (m,) are the utilities of the poses; `none` is the utility of the case that none of them is
    right. The prior (m,) consists of log odds of at most 0, so it raises no pose against that
    case.
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
    # the other places lose the probability that the leading place gains
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    if prior is None or not prior.any():
        return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), most)
    # the prior is not evidence of objects, so its odds are not sharpened
    kept = np.where(agreeing[lead], sharpened[lead] / likely[lead], lost)
    weighted = shares * kept * np.exp(prior)
    none_of_them = max(0.0, 1.0 - float(shares @ kept))
    return np.minimum(agreeing @ weighted / (weighted.sum() + none_of_them), most)


def utilities(supports: Sequence[Support], calibration: Calibration = CALIBRATION
              ) -> NDArray[np.float64]:
    """Return the utility (m,) of each support by objects: log odds, up to a constant."""
    terms = calibration.objects
    return np.array([
        terms.score * pose.score + terms.misfit * pose.misfit + terms.likeness * pose.likeness
        + terms.rarity * pose.rarity + terms.unlabelled * pose.unlabelled
        + terms.unexplained * pose.unexplained + terms.depth * pose.depth
        for pose in supports])


def none_right(setting: Setting, calibration: Calibration = CALIBRATION) -> float:
    """Return the utility of the case that no pose is right."""
    terms = calibration.objects
    return (terms.none_right + terms.map_size * setting.map_size
            + terms.vertical * setting.vertical)


def counted_points(place: RecognizedPlace) -> float:
    """Return how many of the features that agree with a place count as evidence, at least 1."""
    return max(1.0, (CALIBRATION.keyframes.thorough if place.is_thorough else 1.0) * place.inliers)


def points_utility(place: RecognizedPlace) -> float:
    """Return the log odds of a recognized place by its points, against a chance agreement.

    A keyframe near the pose shows the same as the image: if few cells match there, the points are
    a pattern that repeats elsewhere. From farther away, a right pose has fewer points. Features
    do not match across much larger angles or distances.
    """
    terms = CALIBRATION.keyframes
    return min(terms.most, terms.none + terms.confirmed * place.confirmed
               + terms.inliers * math.log(counted_points(place))
               + terms.apart * min(1.0, place.apart) + terms.far * max(0.0, place.apart - 2.0))


def objects_utility(support: Support) -> float:
    """Return the log odds of a pose that keyframes propose, from its objects alone."""
    terms = CALIBRATION.keyframes
    return (terms.explained * min(terms.most_objects, support.inliers)
            + terms.unexplained * min(terms.most_objects, support.unexplained))


def tags_utility(place: TagPlace) -> float:
    """Return the log odds of a place by its tags, against tags that are not where the map says.

    The corners of a tag, in all cameras, are one piece of evidence, that of its name.
    """
    terms = CALIBRATION.tags
    return min(terms.most, terms.one + terms.more * (len(place.names) - 1)
               + terms.others * len(place.others)) - place.misfit


def tagged_objects_utility(support: Support, frames: Sequence[ComparedFrame]) -> float:
    """Return the log odds of a pose that tags propose, from its objects alone.

    Tags are moved, copied and shown on screens. Objects that the pose does not explain therefore
    count more than in the choice between poses of objects.
    """
    if not support.inliers:  # such a support does not count them
        support = Support(unexplained=float(np.mean([frame.are_own.sum() for frame in frames])))
    return float(utilities([support])[0]) + CALIBRATION.tags.unexplained * support.unexplained


def tilt_handicaps(map_from_cameras: NDArray[np.float64], deviation_deg: float
                   ) -> NDArray[np.float64]:
    """Return the log odds (m,), 0 to 4.6, to subtract from each pose for the tilt of its camera.

    Parameters
    ----------
    map_from_cameras : ndarray (m, 4, 4)
        Poses in a map whose third axis is up.
    deviation_deg : float
        Standard deviation of the tilt [deg], see RelocalizerOptions; 0 subtracts nothing.
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
    """Return the log odds (m,), at most 0, of camera poses (m, 4, 4) of a map, given a region.

    They are 0 if the region belongs to a map that is not loaded.
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
    # a region wider than the map says no more than the map itself
    peak = (max(0.0, math.log(area / (2.0 * math.pi)) - 0.5 * np.linalg.slogdet(spot)[1])
            + max(0.0, 0.5 * math.log(2.0 * math.pi / yaw)))
    p = min(max(region.probability, 1e-9), 1.0 - 1e-9)
    odds = np.logaddexp(math.log(1.0 - p), math.log(p) + peak - 0.5 * squares)
    return np.asarray(np.clip(odds, -terms.most, 0.0))
