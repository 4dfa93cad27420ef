# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How likely each hypothesis is right: what speaks for it, against what speaks for the others.

A conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice Behavior", 1974):
each distinct hypothesis has a utility, linear in its support, and so has the case that none of
them is right; the probabilities are as the exponentials of the utilities. So the poses of an
ambiguous scene share the probability. Poses that nearly agree (1 m, 45 degrees) speak for each
other.
"""

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
    sampled_similarities,
)
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation

# Boxes that overlap more than this show one object, detected twice.
_SAME_BOX_IOU = 0.8
# What is right is within 1 m; poses turned by more than this are never both right.
_RIGHT_M = 1.0
_AGREEING_TRACE = 1.0 + 2.0 * np.cos(np.radians(45.0))
# Of a box's edge, as a share of its mean side, and on the plane z = 1.
_EDGE_DEVIATION = (0.2, 0.003)
# The log odds that a vertical said to be known is right: one mount of a hundred is wrong.
_TILTED_PENALTY = 4.6
# No recording is long enough to claim more.
_MOST_CONFIDENCE = 0.9999
# Of labels: so many tell the mean and the deviation of a crop's similarities to 2 %.
_LABELS_SAMPLED = 4096


@dataclass(frozen=True)
class Support:
    """What speaks for a pose, each object counted once.

    Parameters
    ----------
    inliers : int
        Objects that are where the map has them.
    score : float
        Sum of their IoUs.
    misfit : float
        By how much the edges of their boxes miss the outlines: Cauchy's robust sum.
    likeness : float
        By how many standard deviations crops are more similar to the labels of their landmarks
        than to the map's labels on average, summed.
    same_class : float
        How many of the objects have the class of their landmarks.
    unlabelled : float
        How many were matched without labels, by class alone.
    unexplained : float
        How many other objects of the map's classes were detected, and no landmark is there.
    """

    inliers: int = 0
    score: float = 0.0
    misfit: float = 0.0
    likeness: float = 0.0
    same_class: float = 0.0
    unlabelled: float = 0.0
    unexplained: float = 0.0


class Calibration(NamedTuple):
    """The coefficients; ``python -m cliploc_ros.evaluation.calibration`` fits them anew.

    Parameters
    ----------
    score, misfit, likeness, same_class, unlabelled, unexplained : float
        The utility of each unit of support.
    none_right : float
        The utility of the case that no hypothesis is right.
    knee, slope : float
        Log odds beyond the knee grow by 1 + slope: where hardly anything speaks for any other
        pose, wrong ones are rarer than a logit's tail says.
    """

    score: float
    misfit: float
    likeness: float
    same_class: float
    unlabelled: float
    unexplained: float
    none_right: float
    knee: float
    slope: float


#: Fitted on the 258 frames of TUM fr3/long_office_household and the 48 of the demo's world: as
#: they are, with boxes dropped and invented, in maps whose objects have exchanged places; by
#: labels and classes, and by classes alone.
DEFAULT = Calibration(score=2.21, misfit=-0.299, likeness=0.679, same_class=0.416,
                      unlabelled=0.941, unexplained=-0.843, none_right=6.55, knee=0.0,
                      slope=1.16)


class View(NamedTuple):
    """One frame and the map, against which supports are measured.

    Parameters
    ----------
    observation : Observation
    scene : Scene
        Of the observation.
    landmark_map : LandmarkMap
    by_label : bool
        Whether labels were matched; else classes alone.
    """

    observation: Observation
    scene: Scene
    landmark_map: LandmarkMap
    by_label: bool


def support(views: Sequence[View], map_from_cameras: NDArray[np.float64],
            matches: Sequence[Sequence[Match]]) -> Support:
    """Return what speaks for a pose in one frame or several.

    Several boxes on one landmark, and several landmarks behind one box, say no more than the
    best of them. Frames that show one object share the errors of its shape in the map, so that
    their agreement is no more evidence than one of them: it counts with their mean.

    Parameters
    ----------
    views : sequence of F View
    map_from_cameras : ndarray (F, 4, 4)
        Where the pose has the camera of each frame.
    matches : sequence of F sequence of Match
        The inliers of each frame.
    """
    told: dict[int, list[NDArray[np.float64]]] = {}
    for view, map_from_camera, here in zip(views, map_from_cameras, matches, strict=True):
        taken = _each_object_once(here, view.observation.detections.bboxes_xyxy)
        if taken:
            for match, says in zip(taken, _told(view, map_from_camera, taken), strict=True):
                told.setdefault(match.landmark, []).append(says)
    if not told:
        return Support()
    total = np.sum([np.mean(says, axis=0) for says in told.values()], axis=0)
    views_of_each = sum(map(len, told.values())) / len(told)
    unexplained = sum(_unexplained(view, here)
                      for view, here in zip(views, matches, strict=True)) / views_of_each
    return Support(len(told), *map(float, [*total, unexplained]))


def _unexplained(view: View, matches: Sequence[Match]) -> int:
    """Return how many detections of the map's classes have no landmark."""
    classes = view.landmark_map.classes.classes_of(view.observation.detections.class_ids)
    known = set(np.nonzero(classes >= 0)[0])
    return len(known - {match.detection for match in matches})


def _told(view: View, map_from_camera: NDArray[np.float64], matches: Sequence[Match]
          ) -> NDArray[np.float64]:
    """Return what each match (m, 5) adds to a support."""
    detections = np.array([match.detection for match in matches])
    landmarks = np.array([match.landmark for match in matches])
    classes, known = view.observation.detections.class_ids, view.landmark_map.class_ids
    similarities = view.observation.similarities if view.by_label else None
    return np.column_stack([
        [match.iou for match in matches],
        _misfits(view.scene, map_from_camera, detections, landmarks),
        np.zeros(len(matches)) if similarities is None
        else _likenesses(similarities, detections, landmarks),
        [classes[match.detection] == known[match.landmark] for match in matches],
        np.full(len(matches), similarities is None)])


def confidences(supports: Sequence[Support], poses: NDArray[np.float64],
                calibration: Calibration = DEFAULT, upright: NDArray[np.bool_] | None = None
                ) -> NDArray[np.float64]:
    """Return how likely each hypothesis is within 1 m of the truth.

    Parameters
    ----------
    supports : sequence of m Support
    poses : ndarray (m, 4, 4)
        The same hypotheses' map_from_camera.
    calibration : Calibration, optional
    upright : ndarray (m,) of bool, optional
        Which of them were found by a known vertical; where none is known, all.

    Returns
    -------
    ndarray (m,)
        0 to 1; what is left to 1 says that another pose is right, or none of these.
    """
    utilities = np.array([_utility(one, calibration) for one in supports])
    if upright is not None:
        utilities[~upright] -= _TILTED_PENALTY
    shares = np.exp(np.append(utilities, calibration.none_right)
                    - max(utilities.max(), calibration.none_right))
    shares = shares[:-1] / shares.sum()
    agreeing = _agreeing(poses)
    likely = np.clip(agreeing @ shares, 1.0 - _MOST_CONFIDENCE, _MOST_CONFIDENCE)
    log_odds = np.log(likely / (1.0 - likely))
    log_odds += calibration.slope * np.maximum(0.0, log_odds - calibration.knee)
    sharpened = 1.0 / (1.0 + np.exp(-log_odds))
    lead = int(np.argmax(likely))
    # what the leading place gains, the others lose
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), _MOST_CONFIDENCE)


def _utility(one: Support, calibration: Calibration) -> float:
    return (calibration.score * one.score + calibration.misfit * one.misfit
            + calibration.likeness * one.likeness + calibration.same_class * one.same_class
            + calibration.unlabelled * one.unlabelled
            + calibration.unexplained * one.unexplained)


def _agreeing(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which poses (m, 4, 4) are nearly the same (m, m)."""
    positions, rotations = poses[:, :3, 3], poses[:, :3, :3]
    near = np.linalg.norm(positions[:, None] - positions, axis=2) < _RIGHT_M
    traces = np.einsum('iab,jab->ij', rotations, rotations)
    return np.asarray(near & (traces > _AGREEING_TRACE))


def _each_object_once(matches: Sequence[Match], bboxes_xyxy: NDArray[np.float64]) -> list[Match]:
    taken: list[Match] = []
    for match in sorted(matches, key=lambda match: -match.iou):
        boxes = bboxes_xyxy[[other.detection for other in taken]]
        if match.landmark in [other.landmark for other in taken]:
            continue
        if (_box_iou(bboxes_xyxy[match.detection], boxes) > _SAME_BOX_IOU).any():
            continue
        taken.append(match)
    return taken


def _box_iou(box: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU of a box (4,) with others (m, 4)."""
    others = others.reshape(-1, 4)
    overlap = np.prod(np.maximum(0.0, np.minimum(box[2:], others[:, 2:])
                                 - np.maximum(box[:2], others[:, :2])), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    return overlap / (np.prod(box[2:] - box[:2]) + areas - overlap)


def _misfits(scene: Scene, map_from_camera: NDArray[np.float64], detections: NDArray[np.int64],
             landmarks: NDArray[np.int64]) -> NDArray[np.float64]:
    outlines = project_ellipsoids(invert_transform(map_from_camera), scene.centers[landmarks],
                                  scene.shapes[landmarks])
    boxes, halves = scene.box_ellipses[detections], np.sqrt(outlines[:, [2, 4]])
    deviations = (_EDGE_DEVIATION[0] * boxes[:, 2:].mean(axis=1) + _EDGE_DEVIATION[1])[:, None]
    edges = np.concatenate([outlines[:, :2] - halves - boxes[:, :2] + boxes[:, 2:],
                            outlines[:, :2] + halves - boxes[:, :2] - boxes[:, 2:]], axis=1)
    return np.asarray(np.log1p((edges / deviations) ** 2).sum(axis=1))


def _likenesses(similarities: Similarities, detections: NDArray[np.int64],
                landmarks: NDArray[np.int64]) -> NDArray[np.float64]:
    sample = sampled_similarities(similarities, detections, _LABELS_SAMPLED)
    deviations = np.maximum(sample.std(axis=1), 1e-6)
    return np.asarray((pair_similarities(similarities, detections, landmarks)
                       - sample.mean(axis=1)) / deviations)
