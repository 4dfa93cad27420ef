# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The support of a pose: what in the frames speaks for it, and what speaks against it."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.depth import depth_errors, depth_odds
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M, LandmarkMap
from cliploc_ros.core.map.similarities import (
    Similarities,
    pair_similarities,
    sampled_spread,
)
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.search.scene import Scene

# Boxes whose IoU is below the first number show two things, above the second number one thing.
_ONE_THING_IOU = (0.4, 0.8)
# No image reaches further [px].
_FAR_PX = 1e6
# Deviation of a box's edge on the plane z = 1: a share of the box's mean semi-axis, plus a floor.
# .2 of the semi-axis is .1 of the mean side. The calibration is fitted with these values.
_EDGE_DEVIATION = (0.2, 0.003)


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
    #: Of each detection that shows an object, (frame, row): what it adds (7,) to inliers, score,
    #: misfit, likeness, rarity, unlabelled and depth
    shown: Mapping[tuple[int, int], NDArray[np.float64]] = field(
        default_factory=dict, compare=False, repr=False)


class ComparedFrame(NamedTuple):
    """A frame to measure supports in: what all poses share of its n detections."""

    scene: Scene
    classes: NDArray[np.int64]  #: (n,): the map's number of each class
    #: (n,): the logarithm of the number of things for each thing of this class
    rarities: NDArray[np.float64]
    #: (n,): whether the class is some landmark's own, not only what it is taken for
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
        np.maximum(index.sizes_of(classes), 1) / len(landmark_map), common))
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
        unexplained += _unexplained(frame, [match.detection for match in found])
    if not rows:
        return Support()
    shown = {one: row / len(of_object) for of_object in rows.values()
             for one, row in of_object.items()}
    total = np.sum([*shown.values()], axis=0)
    views_of_each = len(shown) / len(rows)
    return Support(*map(float, [*total[:-1], unexplained / views_of_each, total[-1]]),
                   shown=shown)


def _unexplained(frame: ComparedFrame, matched: list[int]) -> float:
    """Return the number of things of the map's classes that no match shows."""
    # A class that a landmark is only taken for does not count: a real person is not expected in a
    # map because a teddy bear sometimes looks like one.
    others = frame.are_own.copy()
    others[matched] = False
    alone = 1.0 - frame.same[others][:, matched].max(axis=1, initial=0.0)
    return float((alone / frame.same[others][:, others].sum(axis=1)).sum())


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
    sigmas = landmark_map.position_sigmas[landmarks]
    return np.column_stack([
        np.ones(len(matches)), [match.iou for match in matches],
        _misfits(frame.scene, map_from_camera, detections, landmarks, sigmas), likenesses,
        shares * frame.rarities[detections], ~compared,
        _depth_odds(frame.scene, map_from_camera, detections, landmarks, sigmas)])


def one_thing(bboxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return to what degree each two of n boxes show one thing (n, n), 0 to 1."""
    boxes = np.clip(np.nan_to_num(bboxes_xyxy), -_FAR_PX, _FAR_PX)
    low = np.maximum(boxes[:, None, :2], boxes[:, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[:, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=2)
    areas = np.diag(shared)
    ious = shared / np.maximum(areas[:, None] + areas - shared, 1e-12)
    least, most = _ONE_THING_IOU
    found = np.clip((ious - least) / (most - least), 0.0, 1.0)
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


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


def _depth_odds(scene: Scene, map_from_camera: NDArray[np.float64], detections: NDArray[np.int64],
                landmarks: NDArray[np.int64], sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the log odds of each match (m,) by its depth; 0 where none was measured."""
    if not scene.depths.any():
        return np.zeros(len(detections))
    camera_from_map = invert_transform(map_from_camera)
    return depth_odds(depth_errors(
        scene.depths[detections], scene.centers[landmarks], scene.shapes[landmarks], sigmas,
        np.ascontiguousarray(camera_from_map[:3, :3]),
        np.ascontiguousarray(camera_from_map[:3, 3])))
