# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One frame of the camera, and all other input at its stamp.

Detections and their similarity to each label, depth, vertical, odometry, and the prior.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.map.similarities import Similarities
from cliploc_ros.errors import OptionsError

#: (4, 4): a body at the camera, with axes x ahead, y left, z up (REP 103)
OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0],
                              [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Detections:
    """The objects a detector found in one image."""

    #: (n, 4): Left, top, right, bottom [px] in the distorted image
    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]  #: Class name of each detection, n of them
    scores: NDArray[np.float64]  #: (n,): detector confidence, 0 to 1

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.class_ids)

    def select(self, rows: NDArray[np.int64]) -> 'Detections':
        """Return the detections of some rows, in this order."""
        return Detections(self.bboxes_xyxy[rows], tuple(self.class_ids[i] for i in rows),
                          self.scores[rows])

    def usable(self, width: int, height: int, limit: int) -> 'Detections':
        """Return the detections that are fit for localization, in their order.

        This drops boxes that are not finite, thinner than a pixel, three times as large as the
        image, or wholly outside of it. Of the others it keeps the most confident ones. Boxes
        that reach over the border stay unchanged.

        Parameters
        ----------
        width, height : int
            Image size [px].
        limit : int
            The most detections to keep. It bounds the time of a search.
        """
        left, top, right, bottom = self.bboxes_xyxy.reshape(-1, 4).T
        with np.errstate(invalid='ignore', over='ignore'):
            sound = (np.isfinite(self.bboxes_xyxy).all(axis=1) & np.isfinite(self.scores)
                     & (right > left) & (bottom > top)
                     & (right > 0) & (bottom > 0) & (left < width) & (top < height))
            # a box far larger than its image, or thinner than a pixel, has wrong units
            sound &= (right - left < 3 * width) & (bottom - top < 3 * height)
            sound &= (right - left >= 1.0) & (bottom - top >= 1.0)
        rows = np.nonzero(sound)[0]
        best = rows[np.argsort(-self.scores[rows], kind='stable')[:limit]]
        return self.select(np.sort(best))


def check_planar(covariance: NDArray[np.float64]) -> None:
    """Raise OptionsError unless this is a covariance (3, 3) of x, y and yaw."""
    if not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance).min() > 0.0:
        raise OptionsError('the covariance of x, y and yaw must be finite and positive definite; '
                           'give 10 rad^2 where yaw is unknown')


@dataclass(frozen=True)
class Region:
    """The prior of the robot's pose: a Gaussian in one map."""

    frame_id: str  #: frame_id of the map
    mean: NDArray[np.float64]  #: (3,): x [m], y [m] and yaw [rad] of the body
    covariance: NDArray[np.float64]  #: (3, 3): of these, positive definite
    probability: float  #: Probability that this is right; else the robot may be anywhere
    #: (4, 4): the body, whose x axis points ahead; by default one that looks as the camera does
    camera_from_body: NDArray[np.float64] = field(default_factory=OPTICAL_FROM_BODY.copy)

    def __post_init__(self) -> None:
        """Raise OptionsError unless this is a region."""
        if not np.isfinite(self.mean).all() or not 0.0 <= self.probability <= 1.0:
            raise OptionsError(f'region: {self.mean} must be finite, and its probability '
                               f'{self.probability} 0 to 1')
        check_planar(self.covariance)


@dataclass(frozen=True)
class Observation:
    """A frame's detections with its camera and time."""

    camera: Camera
    detections: Detections  #: n of them
    #: (n, L): cosine similarity of each compared detection's crop with the label
    #: of each of the map's L landmarks, in the map's order. None if only classes are known.
    similarities: Similarities | None = None
    stamp_ns: int = 0  #: Time of the image [ns]
    camera_name: str = ''  #: Which of several cameras took it
    #: (3,): the vertical, a unit vector in the camera's optical coordinate frame; None if unknown
    up_in_camera: NDArray[np.float64] | None = None
    #: (4, 4): the camera in the coordinate frame of odometry, which links this frame to others;
    #: None if unknown
    odom_from_camera: NDArray[np.float64] | None = None
    #: Way driven since the run of odometry began [m]; 0 where it is unknown
    odom_way_m: float = 0.0
    #: (m,): the detections that the rows of similarities (m, L) belong to; None for all, in their
    #: order. The other detections are matched by class alone.
    compared: NDArray[np.int64] | None = None
    #: (n,): median depth of the inner half of each box, along z of the camera [m]; NaN where there
    #: is none. None for a camera without depth.
    depths: NDArray[np.float64] | None = None
    #: (n,): standard deviation of each depth [m]; None for those of a usual RGB-D camera
    depth_deviations: NDArray[np.float64] | None = None
    region: Region | None = None  #: Where the robot probably is; None if nothing is known

    @property
    def similarity_rows(self) -> NDArray[np.int64]:
        """Return the row of similarities of each detection (n,); -1 where there is none."""
        rows = np.full(len(self.detections), -1, dtype=np.int64)
        if self.similarities is None:
            return rows
        if self.compared is None:
            return np.arange(len(self.detections))
        rows[self.compared] = np.arange(len(self.compared))
        return rows
