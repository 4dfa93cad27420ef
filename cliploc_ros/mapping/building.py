# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of mapping: posed detections in, landmarks and a report out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.association import associate
from cliploc_ros.mapping.evidence import Evidence, gather_evidence, group_boxes
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks, join_landmarks, no_landmarks
from cliploc_ros.mapping.merging import merge_duplicates
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.selection import reasons_against
from cliploc_ros.mapping.triangulation import triangulate
from cliploc_ros.mapping.views import Views, make_views


@dataclass(frozen=True)
class BuiltMap:
    """The result of mapping.

    Parameters
    ----------
    landmarks : Landmarks
        L of them.
    evidence : Evidence
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    """

    landmarks: Landmarks
    evidence: Evidence
    shown: NDArray[np.int64]
    left_out: Landmarks
    reasons: tuple[str, ...]
    left_out_evidence: Evidence


def build_map(detections: PosedDetections, options: MappingOptions | None = None,
              progress: Callable[[str, float], None] | None = None) -> BuiltMap:
    """Build landmarks from posed detections."""
    options = options or MappingOptions()
    views = make_views(detections, options)
    rng = np.random.default_rng(options.random_seed)
    landmarks = no_landmarks()
    for _ in range(options.discovery_rounds):
        free = (associate(views, landmarks, options.association_iou) < 0 if len(landmarks.centers)
                else np.ones(len(views.frames), dtype=np.bool_))
        found = discover(views, free, options, rng)
        landmarks = settle(views, join_landmarks(landmarks, found), options)
    shown = associate(views, landmarks, options.association_iou)
    evidence = gather_evidence(views, landmarks, shown)
    reasons = reasons_against(landmarks, evidence, options)
    keep = np.array([reason is None for reason in reasons], dtype=np.bool_)
    kept = landmarks.select(keep)
    for _ in range(2):
        shown = associate(views, kept, options.association_iou)
        kept = refit(views, kept, shown)
    shown = associate(views, kept, options.association_iou)
    return BuiltMap(kept, gather_evidence(views, kept, shown), shown, landmarks.select(~keep),
                    tuple(reason for reason in reasons if reason is not None),
                    Evidence(*(column[~keep] for column in evidence)))


def discover(views: Views, free: NDArray[np.bool_], options: MappingOptions,
             rng: np.random.Generator) -> Landmarks:
    """Return landmarks that explain the free boxes, class by class."""
    return join_landmarks(*(
        triangulate(views, np.nonzero(free & (views.classes == number))[0], options, rng)
        for number in np.unique(views.classes[free])))


def settle(views: Views, landmarks: Landmarks, options: MappingOptions) -> Landmarks:
    """Associate, merge and refit until landmarks and boxes agree."""
    for _ in range(options.settling_rounds):
        shown = associate(views, landmarks, options.association_iou)
        landmarks, shown = merge_duplicates(views, landmarks, shown, options)
        landmarks = refit(views, landmarks, shown)
        shown = associate(views, landmarks, options.association_iou)
        viewpoints = views.viewpoints[views.frames]
        seen = np.array([len(np.unique(viewpoints[rows])) >= options.min_viewpoints
                         for rows in group_boxes(shown, len(landmarks.centers))], dtype=np.bool_)
        landmarks = landmarks.select(seen)
    return landmarks


def refit(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]) -> Landmarks:
    """Return the landmarks fitted to the boxes that show them."""
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    for number, rows in enumerate(group_boxes(shown, len(centers))):
        if len(rows):
            fit = fit_ellipsoid(views, rows, centers[number], bases[number])
            centers[number], bases[number] = fit.center, fit.basis
    return Landmarks(centers, bases, landmarks.classes)
