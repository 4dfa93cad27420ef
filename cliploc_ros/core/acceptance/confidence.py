# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The confidence of each hypothesis: the support of a pose, weighed against that of the others.

A conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice Behavior", 1974):
each distinct hypothesis has a utility, linear in its support. So has the case that none of them
is right: the more landmarks the map has, the more wrong poses fit by chance; a known vertical
leaves fewer. Probabilities are proportional to the exponentials of the utilities, so the poses of
an ambiguous scene share the probability. Poses that agree (1 m, 45 degrees) add up theirs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.scene import Scene
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.index.similarities import (
    Similarities,
    pair_similarities,
    sampled_spread,
)
from cliploc_ros.core.landmark_map import DEFAULT_SIGMA_M, LandmarkMap

# Boxes that overlap more than this show the same object, detected twice.
_SAME_BOX_IOU = 0.8
#: A right pose is within this distance of the truth [m].
RIGHT_M = 1.0
# Two poses turned by more than 45 degrees are never both right.
_AGREEING_TRACE = 1.0 + 2.0 * np.cos(np.radians(45.0))
# Deviation of a box's edge on the plane z = 1: a share of the box's mean semi-axis, plus a floor.
# .2 of the semi-axis is .1 of the mean side. The calibration is fitted with these values.
_EDGE_DEVIATION = (0.2, 0.003)
# Deviations [deg] of the best vertical that the fit has seen, and of one that is no help.
_BEST_VERTICAL_DEG, _VAGUE_VERTICAL_DEG = 0.5, 45.0
# The data are too few to justify a higher confidence.
_MOST_CONFIDENCE = 0.9999


@dataclass(frozen=True)
class Support:
    """The support of a pose; each object counts once.

    Parameters
    ----------
    inliers : int
        Number of objects that are where the map has them.
    score : float
        Sum of their IoUs.
    misfit : float
        How far the edges of their boxes are from the outlines: Cauchy's robust sum.
    likeness : float
        How much more similar their crops are to the labels of their landmarks than to the map's
        labels on average, in standard deviations, summed.
    rarity : float
        Summed over the objects that have a class of their landmark: the logarithm of the map's
        number of landmarks for each landmark of this class. A chance match of a rare class is
        rarer than one of a common class. A class that the detector takes the landmark for at
        times counts by its share, see ClassIndex.shares.
    unlabelled : float
        Number of the objects that were matched by class alone.
    unexplained : float
        Number of other detected objects of the map's classes, which no landmark explains.
    """

    inliers: int = 0
    score: float = 0.0
    misfit: float = 0.0
    likeness: float = 0.0
    rarity: float = 0.0
    unlabelled: float = 0.0
    unexplained: float = 0.0


class Setting(NamedTuple):
    """What the chance of a wrong pose depends on, besides the supports.

    Parameters
    ----------
    landmarks : int
        Number of landmarks in the map.
    vertical_deg : float
        Standard deviation of the known vertical [deg]; infinite where none is known.
    """

    landmarks: int
    vertical_deg: float = math.inf

    @property
    def map_size(self) -> float:
        """Return the logarithm of the number of landmarks."""
        return math.log(max(1, self.landmarks))

    @property
    def vertical(self) -> float:
        """Return what the vertical rules out: 0 where none is known, 3.8 for one to 1 degree."""
        return math.log(_VAGUE_VERTICAL_DEG / min(max(self.vertical_deg, _BEST_VERTICAL_DEG),
                                                  _VAGUE_VERTICAL_DEG))


class Calibration(NamedTuple):
    """The coefficients; ``python -m cliploc_ros.evaluation.worlds.fit`` fits them.

    Parameters
    ----------
    score, misfit, likeness, rarity, unlabelled, unexplained : float
        Utility of a unit of each kind of support.
    none_right, map_size, vertical : float
        Utility of the case that no hypothesis is right: a constant, and a unit of each part of
        the setting.
    knee, slope : float
        Log odds beyond the knee grow by 1 + slope: where all other poses have hardly any
        support, wrong poses are rarer than the tail of a logit.
    """

    score: float
    misfit: float
    likeness: float
    rarity: float
    unlabelled: float
    unexplained: float
    none_right: float
    map_size: float
    vertical: float
    knee: float
    slope: float


#: The data that DEFAULT is fitted on. Figures measured on them are not held out.
FITTED_ON = 'simulated rooms, offices, shops and bare rooms (24 of each)'
#: Fitted with and without what else is known, and in maps whose objects have exchanged places; by
#: labels and classes, and by classes alone.
DEFAULT = Calibration(score=2.06, misfit=-0.315, likeness=0.396, rarity=0.524, unlabelled=0.594,
                      unexplained=-0.825, none_right=1.33, map_size=1.55, vertical=-0.637,
                      knee=0.0, slope=0.433)


class ComparedFrame(NamedTuple):
    """A frame to measure supports in.

    Parameters
    ----------
    bboxes_xyxy : ndarray (n, 4)
        [px]
    class_ids : tuple of str
        Class of each detection, n of them.
    similarities : Similarities or None
        None where classes alone are matched.
    scene : Scene
        Of the same detections.
    similarity_rows : ndarray (n,) of int
        Row of similarities of each detection; -1 where its class alone is matched.
    """

    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]
    similarities: Similarities | None
    scene: Scene
    similarity_rows: NDArray[np.int64]


def support(landmark_map: LandmarkMap, frames: Sequence[ComparedFrame],
            map_from_cameras: NDArray[np.float64], matches: Sequence[Sequence[Match]]) -> Support:
    """Return the support of a pose in one frame or several.

    Several boxes on one landmark, or several landmarks behind one box, count as the best of them.
    Frames that show the same object share the error of its shape in the map, so their agreement
    is no more evidence than one of them: the object counts with their mean.

    Parameters
    ----------
    landmark_map : LandmarkMap
    frames : sequence of F ComparedFrame
    map_from_cameras : ndarray (F, 4, 4)
        Pose of the camera in each frame.
    matches : sequence of F sequence of Match
        Inliers in each frame.
    """
    rows: dict[int, list[NDArray[np.float64]]] = {}  # by object: maps have duplicates
    for frame, map_from_camera, found in zip(frames, map_from_cameras, matches, strict=True):
        distinct = _each_object_once(found, frame.bboxes_xyxy, landmark_map.objects)
        if distinct:
            for match, row in zip(distinct, _contributions(landmark_map, frame, map_from_camera,
                                                           distinct), strict=True):
                rows.setdefault(int(landmark_map.objects[match.landmark]), []).append(row)
    if not rows:
        return Support()
    total = np.sum([np.mean(of_object, axis=0) for of_object in rows.values()], axis=0)
    views_of_each = sum(map(len, rows.values())) / len(rows)
    unexplained = sum(_unexplained(landmark_map, frame, found)
                      for frame, found in zip(frames, matches, strict=True)) / views_of_each
    return Support(len(rows), *map(float, [*total, unexplained]))


def _unexplained(landmark_map: LandmarkMap, frame: ComparedFrame, matches: Sequence[Match]) -> int:
    """Return how many detections of the map's classes match no landmark.

    A class that a landmark is only taken for does not count: a real person is not expected in a
    map because a teddy bear sometimes looks like one.
    """
    index = landmark_map.classes
    known = set(np.nonzero(index.are_own(index.classes_of(frame.class_ids)))[0])
    return len(known - {match.detection for match in matches})


def _contributions(landmark_map: LandmarkMap, frame: ComparedFrame,
                   map_from_camera: NDArray[np.float64], matches: Sequence[Match]
                   ) -> NDArray[np.float64]:
    """Return what each match (m, 5) adds to a support."""
    detections = np.array([match.detection for match in matches])
    landmarks = np.array([match.landmark for match in matches])
    classes = landmark_map.classes.classes_of(frame.class_ids)
    rows, likenesses = frame.similarity_rows[detections], np.zeros(len(matches))
    compared = rows >= 0
    if frame.similarities is not None and compared.any():
        likenesses[compared] = _likenesses(frame.similarities, rows[compared],
                                           landmarks[compared])
    return np.column_stack([
        [match.iou for match in matches],
        _misfits(frame.scene, map_from_camera, detections, landmarks,
                 landmark_map.position_sigmas[landmarks]), likenesses,
        _rarities(landmark_map, landmarks, classes[detections]), ~compared])


def _rarities(landmark_map: LandmarkMap, landmarks: NDArray[np.int64],
              classes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how rare the class of each detection (m,) is; 0 if it is none of its landmark."""
    index = landmark_map.classes
    shares = np.maximum(index.sizes_of(classes), 1) / len(landmark_map)
    return -np.log(shares) * index.shares(landmarks, classes)


def confidences(supports: Sequence[Support], poses: NDArray[np.float64], setting: Setting,
                calibration: Calibration = DEFAULT,
                handicaps: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    """Return the probability that each hypothesis is within 1 m of the truth.

    Parameters
    ----------
    supports : sequence of m Support
    poses : ndarray (m, 4, 4)
        map_from_camera of the same hypotheses.
    setting : Setting
    calibration : Calibration, optional
    handicaps : ndarray (m,), optional
        Log odds that speak against each hypothesis besides its support.

    Returns
    -------
    ndarray (m,)
        0 to 1. The rest to 1 is the probability that another pose is right, or none.
    """
    odds = utilities(supports, calibration) - handicaps
    none = none_right(setting, calibration)
    shares = np.exp(np.append(odds, none) - max(odds.max(), none))
    shares = shares[:-1] / shares.sum()
    agreeing = agreeing_poses(poses)
    likely = np.clip(agreeing @ shares, 1.0 - _MOST_CONFIDENCE, _MOST_CONFIDENCE)
    log_odds = np.log(likely / (1.0 - likely))
    log_odds += calibration.slope * np.maximum(0.0, log_odds - calibration.knee)
    sharpened = 1.0 / (1.0 + np.exp(-log_odds))
    lead = int(np.argmax(likely))
    # the other places lose what the leading place gains
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), _MOST_CONFIDENCE)


def utilities(supports: Sequence[Support], calibration: Calibration = DEFAULT
              ) -> NDArray[np.float64]:
    """Return the utility (m,) of each support: the logarithm of its odds, up to a constant."""
    return np.array([
        calibration.score * one.score + calibration.misfit * one.misfit
        + calibration.likeness * one.likeness + calibration.rarity * one.rarity
        + calibration.unlabelled * one.unlabelled + calibration.unexplained * one.unexplained
        for one in supports])


def none_right(setting: Setting, calibration: Calibration = DEFAULT) -> float:
    """Return the utility of the case that no hypothesis is right."""
    return (calibration.none_right + calibration.map_size * setting.map_size
            + calibration.vertical * setting.vertical)


def agreeing_poses(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (m, m): which of the poses (m, 4, 4) agree to 1 m and 45 degrees."""
    positions, rotations = poses[:, :3, 3], poses[:, :3, :3]
    near = np.linalg.norm(positions[:, None] - positions, axis=2) < RIGHT_M
    traces = np.einsum('iab,jab->ij', rotations, rotations)
    return np.asarray(near & (traces > _AGREEING_TRACE))


def _each_object_once(matches: Sequence[Match], bboxes_xyxy: NDArray[np.float64],
                      objects: NDArray[np.int64]) -> list[Match]:
    """Return the best match of each landmark's object and of each box."""
    distinct: list[Match] = []
    for match in sorted(matches, key=lambda match: -match.iou):
        boxes = bboxes_xyxy[[other.detection for other in distinct]]
        if objects[match.landmark] in objects[[other.landmark for other in distinct]]:
            continue
        if (_box_iou(bboxes_xyxy[match.detection], boxes) > _SAME_BOX_IOU).any():
            continue
        distinct.append(match)
    return distinct


def _box_iou(box: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU of a box (4,) with others (m, 4)."""
    others = others.reshape(-1, 4)
    overlap = np.prod(np.maximum(0.0, np.minimum(box[2:], others[:, 2:])
                                 - np.maximum(box[:2], others[:, :2])), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    return overlap / (np.prod(box[2:] - box[:2]) + areas - overlap)


def _misfits(scene: Scene, map_from_camera: NDArray[np.float64], detections: NDArray[np.int64],
             landmarks: NDArray[np.int64], sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    camera_from_map = invert_transform(map_from_camera)
    outlines = project_ellipsoids(camera_from_map, scene.centers[landmarks],
                                  scene.shapes[landmarks])
    boxes, halves = scene.box_ellipses[detections], np.sqrt(outlines[:, [2, 4]])
    depths = scene.centers[landmarks] @ camera_from_map[2, :3] + camera_from_map[2, 3]
    # the calibration's maps are no worse than the default
    more = np.sqrt(np.maximum(0.0, sigmas ** 2 - DEFAULT_SIGMA_M ** 2)) / depths
    deviations = np.hypot(_EDGE_DEVIATION[0] * boxes[:, 2:].mean(axis=1) + _EDGE_DEVIATION[1],
                          more)[:, None]
    edges = np.concatenate([outlines[:, :2] - halves - boxes[:, :2] + boxes[:, 2:],
                            outlines[:, :2] + halves - boxes[:, :2] - boxes[:, 2:]], axis=1)
    return np.asarray(np.log1p((edges / deviations) ** 2).sum(axis=1))


def _likenesses(similarities: Similarities, rows: NDArray[np.int64],
                landmarks: NDArray[np.int64]) -> NDArray[np.float64]:
    means, deviations = sampled_spread(similarities, rows)
    return np.asarray((pair_similarities(similarities, rows, landmarks) - means)
                      / np.maximum(deviations, 1e-6))
