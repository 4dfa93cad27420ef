# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How to build a map: every choice that mapping leaves to its user."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PoseErrors:
    """How the errors of given poses behave.

    Parameters
    ----------
    sigma_m, sigma_deg : float
        Standard deviations on each axis [m] [deg].
    correlation_s : float
        Time constant with which an error forgets itself [s]; 0: every frame errs on its own.
    """

    sigma_m: float
    sigma_deg: float
    correlation_s: float = 3.0

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviations (6,) [m] [rad]."""
        return np.repeat([self.sigma_m, np.radians(self.sigma_deg)], 3)


@dataclass(frozen=True)
class OdometryErrors:
    """How the errors of odometry grow, as a random walk. All defaults are guesses.

    Parameters
    ----------
    sigma_m, sigma_deg : float
        Standard deviations on each axis after a metre [m] [deg].
    metres_per_radian : float
        A radian of turning counts as so many metres: wheels move then, too.
    floor_m, floor_deg : float
        Of each step, for stamps and interpolation [m] [deg].
    """

    sigma_m: float = 0.03
    sigma_deg: float = 1.5
    metres_per_radian: float = 0.5
    floor_m: float = 0.002
    floor_deg: float = 0.1

    def sigmas(self, distances_m: NDArray[np.float64], angles: NDArray[np.float64]
               ) -> NDArray[np.float64]:
        """Return deviations (m, 2) [m] [rad] after ways (m,) [m] with turns (m,) [rad]."""
        ways = (distances_m + self.metres_per_radian * angles)[:, None]
        sigmas = np.hypot([self.floor_m, self.floor_deg],
                          np.sqrt(ways) * [self.sigma_m, self.sigma_deg])
        return np.asarray(sigmas * [1.0, np.radians(1.0)])


_ODOMETRY_ERRORS = OdometryErrors()


@dataclass(frozen=True)
class MappingOptions:
    """Options of mapping.

    Parameters
    ----------
    edge_sigma_px, edge_sigma_share : float
        Standard deviation of a box's edge: [px], and as a share of the box's extent; both are
        added in squares.
    border_px : float
        An edge this near to the image border is open: the object may extend beyond it [px].
    pairs_per_box : int
        Hypotheses that each box is the seed of.
    frames_per_viewpoint : int
        At most so many frames of a viewpoint are searched for new landmarks.
    min_viewpoints : int
        A landmark needs support from so many viewpoints.
    discovery_rounds, settling_rounds : int
        How often boxes without a landmark are searched for new ones, and how often after that
        landmarks are associated, merged and fitted.
    association_iou : float
        A box and a landmark that overlap less do not belong together.
    merge_distance : float
        Landmarks of one class nearer than this may be one object, see
        cliploc_ros.mapping.merging.normalized_distance.
    class_merge_distance : float
        The same for landmarks of two classes.
    max_seen_apart : float
        Unless more than this share of the frames of the rarer one show them as two boxes.
    merge_loss : float
        Or the mean IoU of their boxes falls by more than this.
    min_seen_ratio : float
        Share of the frames showing a landmark's place in which it must be detected. Chance
        arrangements of boxes are seen rarely, but so are objects that others hide.
    min_baseline_deg : float
        Least angle between two of its directions [deg].
    max_position_sigma_m, max_position_sigma_share : float
        Greatest deviation of a centre: [m], or as a share of the landmark's size.
    min_median_iou : float
        Of a landmark's boxes.
    pose_errors : PoseErrors, optional
        Refine the poses with the landmarks, as far as they may be off; None: poses are exact.
    estimate_pose_errors : bool
        Without pose_errors, estimate them, and refine the poses where they are significant.
    odometry_errors : OdometryErrors
        Of odometry between frames, which joins the poses while they are refined.
    refine_mount : bool
        Correct the mount of the camera, which all poses share.
    rebuilds : int
        How often the map is built anew with refined poses.
    refinements : int
        How often poses and landmarks are refined together before each of these, and after all.
    frame_id, source : str
        What the map says of itself: its coordinate frame, and where it comes from.
    random_seed : int
        Equal seed and input give equal output.
    """

    edge_sigma_px: float = 2.0
    edge_sigma_share: float = 0.04
    border_px: float = 3.0
    pairs_per_box: int = 3
    frames_per_viewpoint: int = 8
    min_viewpoints: int = 3
    discovery_rounds: int = 2
    settling_rounds: int = 3
    association_iou: float = 0.2
    merge_distance: float = 0.8
    class_merge_distance: float = 0.4
    max_seen_apart: float = 0.15
    merge_loss: float = 0.1
    min_seen_ratio: float = 0.03
    min_baseline_deg: float = 20.0
    max_position_sigma_m: float = 0.05
    max_position_sigma_share: float = 0.1
    min_median_iou: float = 0.5
    pose_errors: PoseErrors | None = None
    estimate_pose_errors: bool = False
    odometry_errors: OdometryErrors = _ODOMETRY_ERRORS
    refine_mount: bool = False
    rebuilds: int = 1
    refinements: int = 3
    frame_id: str = 'map'
    source: str = 'build_map'
    random_seed: int = 0
