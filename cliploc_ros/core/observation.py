# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One frame of the camera, and all other input at its stamp.

It consists of detections and their similarity to each label, depth, vertical, odometry, and the
prior.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.map.similarities import Similarities
from cliploc_ros.errors import OptionsError

#: (4, 4): optical_from_body of a body at the camera, with x forward, y left, z up (REP 103)
OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0],
                              [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Detections:
    """The objects that a detector found in one image."""

    #: (n, 4): left, top, right, bottom [px] in the distorted image
    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]  #: Class name of each detection, n of them
    scores: NDArray[np.float64]  #: (n,): detector confidence, 0 to 1

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.class_ids)

    def select(self, rows: NDArray[np.int64]) -> 'Detections':
        """Return the detections of the given rows, in the order of the rows."""
        return Detections(self.bboxes_xyxy[rows], tuple(self.class_ids[i] for i in rows),
                          self.scores[rows])

    def usable(self, width: int, height: int, limit: int) -> 'Detections':
        """Return the detections that are fit for localization, without changing their order.

        This drops boxes that are not finite, narrower than a pixel, three times as large as the
        image, or completely outside it. If more than `limit` are left, the most confident
        detections are kept. Boxes that extend beyond the border stay unchanged.

        Parameters
        ----------
        width, height : int
            Image size [px].
        limit : int
            Maximum number of detections. It limits the time of a search.
        """
        left, top, right, bottom = self.bboxes_xyxy.reshape(-1, 4).T
        with np.errstate(invalid='ignore', over='ignore'):
            sound = (np.isfinite(self.bboxes_xyxy).all(axis=1) & np.isfinite(self.scores)
                     & (right > left) & (bottom > top)
                     & (right > 0) & (bottom > 0) & (left < width) & (top < height))
            # a box far larger than its image, or narrower than a pixel, has wrong units
            sound &= (right - left < 3 * width) & (bottom - top < 3 * height)
            sound &= (right - left >= 1.0) & (bottom - top >= 1.0)
        rows = np.nonzero(sound)[0]
        return self.select(np.sort(rows[np.argsort(-self.scores[rows], kind='stable')[:limit]]))


@dataclass(frozen=True)
class SeenTags:
    """The tags that an image shows."""

    names: tuple[str, ...]  #: n names, FAMILY_ID, such as tag36h11_12
    #: (n, 4, 2): corners in the distorted image, top left of the tag first, then clockwise [px]
    corners_px: NDArray[np.float64]


NO_TAGS = SeenTags((), np.empty((0, 4, 2)))


def check_planar(covariance: NDArray[np.float64]) -> None:
    """Raise OptionsError unless this is a covariance (3, 3) of x, y and yaw."""
    if not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance).min() > 0.0:
        raise OptionsError('the covariance of x, y and yaw must be finite and positive definite; '
                           'set the variance of an unknown yaw to 10 rad^2')


@dataclass(frozen=True)
class Region:
    """The prior of the robot's pose: a Gaussian in one map."""

    frame_id: str  #: frame_id of the map
    mean: NDArray[np.float64]  #: (3,): x [m], y [m] and yaw [rad] of the body
    covariance: NDArray[np.float64]  #: (3, 3): covariance of x, y and yaw, positive definite
    probability: float  #: Probability that the region is right; else the robot may be anywhere
    #: (4, 4): pose of the body, whose x axis points forward; by default the camera looks forward
    camera_from_body: NDArray[np.float64] = field(default_factory=OPTICAL_FROM_BODY.copy)

    def __post_init__(self) -> None:
        """Raise OptionsError if mean, covariance or probability are invalid."""
        if not np.isfinite(self.mean).all() or not 0.0 <= self.probability <= 1.0:
            raise OptionsError(f'region: mean {self.mean} must be finite, and probability '
                               f'{self.probability} from 0 to 1')
        check_planar(self.covariance)


def tilt_deg(map_from_camera: NDArray[np.float64], up_in_camera: NDArray[np.float64] | None
             ) -> float:
    """Return the angle of a direction (3,) to the vertical at a pose (4, 4) [deg]; unknown: 0."""
    return 0.0 if up_in_camera is None else math.degrees(math.acos(
        np.clip(map_from_camera[2, :3] @ up_in_camera, -1.0, 1.0)))


@dataclass(frozen=True)
class Observation:
    """The detections of a frame, with its camera, time and other input."""

    camera: Camera
    detections: Detections  #: n detections
    #: (m, L): cosine similarity of the crop of each compared detection to the label of each of the
    #: map's L landmarks, in the map's order. None if only classes are known.
    similarities: Similarities | None = None
    stamp_ns: int = 0  #: Time of the image [ns]
    camera_name: str = ''  #: Name of the camera if there are several
    #: (3,): the vertical, a unit vector in the camera's optical coordinate frame; None if unknown
    up_in_camera: NDArray[np.float64] | None = None
    #: (4, 4): the camera in the coordinate frame of odometry, which links this frame to others;
    #: None if unknown
    odom_from_camera: NDArray[np.float64] | None = None
    #: Distance driven since the run of odometry began [m]; 0 if unknown
    odom_way_m: float = 0.0
    #: (m,): the detections that the rows of similarities belong to; None for all n detections in
    #: their order. The other detections are matched by class alone.
    compared: NDArray[np.int64] | None = None
    #: (n,): median depth of the inner half of each box, along z of the camera [m]; NaN if unknown.
    #: None for a camera without depth.
    depths: NDArray[np.float64] | None = None
    region: Region | None = None  #: Where the robot probably is; None if unknown
    #: (3,): the z axis of base_frame, a unit vector in the camera's optical coordinate frame; None
    #: without a base_frame
    base_up_in_camera: NDArray[np.float64] | None = None
    tags: SeenTags | None = None  #: None if nobody looked for tags

    @property
    def similarity_rows(self) -> NDArray[np.int64]:
        """Return the row of similarities of each detection (n,); -1 if it was not compared."""
        rows = np.full(len(self.detections), -1, dtype=np.int64)
        if self.similarities is None:
            return rows
        if self.compared is None:
            return np.arange(len(self.detections))
        rows[self.compared] = np.arange(len(self.compared))
        return rows
