# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The landmarks of the old map as the recording's classes name them, and which boxes show them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.mapping.association import associate
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes, landmarks_of_map
from cliploc_ros.mapping.updating.options import UpdateOptions
from cliploc_ros.mapping.views import Views

# A position is known no better than this [m]: objects are no ellipsoids. A guess.
_LEAST_SIGMA_M = 0.01


class Known(NamedTuple):
    """L landmarks of the old map."""

    landmarks: Landmarks  #: Class -1: no box of the recording has a class of this landmark
    sigmas: NDArray[np.float64]  #: (L,): deviations of the centres [m]
    details: tuple[LandmarkDetails, ...]
    named: Landmarks  #: The landmarks once for each of their classes
    owners: NDArray[np.int64]  #: The landmark of each of these

    def select(self, rows: NDArray[np.int64]) -> 'Known':
        """Return some of the landmarks, by their main classes only."""
        landmarks = self.landmarks.select(rows)
        return Known(landmarks, self.sigmas[rows], tuple(self.details[row] for row in rows),
                     landmarks, np.arange(len(rows)))


def known_landmarks(old: LandmarkMap, class_names: tuple[str, ...], options: UpdateOptions
                    ) -> Known:
    """Return the landmarks of a map for a recording with some classes."""
    details = old.details or (LandmarkDetails(),) * len(old)
    numbers = {name: number for number, name in enumerate(class_names)}
    names = [(row, numbers[name]) for row, one in enumerate(details)
             for name in dict.fromkeys((old.class_ids[row], *dict(one.class_weights or ())))
             if name in numbers]
    owners, classes = np.array(names, dtype=np.int64).reshape(-1, 2).T
    landmarks = landmarks_of_map(old, class_names)
    first = np.full(len(old), -1, dtype=np.int64)
    first[owners[::-1]] = classes[::-1]
    sigmas = np.array([options.unknown_sigma_m if one.position_sigma is None
                       else one.position_sigma for one in details])
    return Known(landmarks._replace(classes=first), np.maximum(sigmas, _LEAST_SIGMA_M), details,
                 Landmarks(landmarks.centers[owners], landmarks.bases[owners], classes), owners)


def find_known(views: Views, known: Known, min_iou: float) -> NDArray[np.int64]:
    """Return the old landmark (n,) that each box shows, -1 for none.

    One landmark has at most one box in a frame, whatever its classes.
    """
    shown = associate(views, known.named, min_iou)
    shown[shown >= 0] = known.owners[shown[shown >= 0]]
    rows = np.nonzero(shown >= 0)[0]
    keys = views.frames[rows] * len(known.landmarks.centers) + shown[rows]
    _, kept = np.unique(keys, return_index=True)
    once = np.full(len(shown), -1, dtype=np.int64)
    once[rows[kept]] = shown[rows[kept]]
    return once


class Refits(NamedTuple):
    """L landmarks where the recording puts them; unchanged where it does not tell."""

    landmarks: Landmarks
    #: (L, 3, 3): of the centres [m^2]; infinite where the recording does not tell
    covariances: NDArray[np.float64]

    def select(self, rows: NDArray[np.int64]) -> 'Refits':
        """Return some of the landmarks."""
        return Refits(self.landmarks.select(rows), self.covariances[rows])

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Return which landmarks (L,) the recording places."""
        return np.isfinite(self.covariances[:, 0, 0])

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the deviations (L,) of the centres on the worst axis [m]."""
        sigmas = np.full(len(self.covariances), np.inf)
        own = self.covariances[self.is_known]
        sigmas[self.is_known] = np.sqrt(np.linalg.eigvalsh(own)[:, -1])
        return sigmas


def refit(views: Views, landmarks: Landmarks, shown: NDArray[np.int64], min_viewpoints: int
          ) -> Refits:
    """Fit landmarks to the boxes that show them from enough viewpoints."""
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    covariances = np.full((len(centers), 3, 3), np.inf)
    for number, rows in enumerate(group_boxes(shown, len(centers))):
        if len(np.unique(views.viewpoints[views.frames[rows]])) >= min_viewpoints:
            fit = fit_ellipsoid(views, rows, centers[number], bases[number])
            centers[number], bases[number] = fit.center, fit.basis
            covariances[number] = (np.linalg.inv(fit.information)[:3, :3]
                                   + _LEAST_SIGMA_M ** 2 * np.eye(3))
    return Refits(Landmarks(centers, bases, landmarks.classes), covariances)


def ellipsoid_numbers(bases: NDArray[np.float64]
                      ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return semi-axes (L, 3) and quaternions x, y, z, w (L, 4) of bases (L, 3, 3)."""
    semi_axes = np.linalg.norm(bases, axis=1)
    rotations = bases / semi_axes[:, None, :]
    rotations[np.linalg.det(rotations) < 0.0] *= -1.0
    return semi_axes, Rotation.from_matrix(rotations).as_quat()
