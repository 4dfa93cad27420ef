# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of building and checking a map."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.offline.vocabulary.vocabulary import common_name

#: Frames within this time are simultaneous [s]; the share of a pose error that simultaneous frames
#: have in common if errors have no time constant.
INSTANT_S, _KEPT_AT_ONCE = 1e-3, 0.999


@dataclass(frozen=True)
class PoseErrors:
    """Model of the errors of given poses."""

    #: Standard deviations on each axis [m] [deg]
    sigma_m: float
    sigma_deg: float
    #: Time constant of the decay of an error [s]; 0: the errors of frames are independent
    correlation_s: float = 3.0

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviations (6,) [m] [rad]."""
        return np.repeat([self.sigma_m, np.radians(self.sigma_deg)], 3)

    def kept(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of an error that remains after times (n,) [s].

        Simultaneous frames are from several cameras of one robot, so they share their errors.
        """
        if self.correlation_s > 0.0:
            return np.asarray(np.exp(-seconds / self.correlation_s))
        return np.where(seconds <= INSTANT_S, _KEPT_AT_ONCE, 0.0)


@dataclass(frozen=True)
class OdometryErrors:
    """Model of the errors of odometry: a random walk.

    The defaults are not measured; the errors of the angle of a Husky's wheels are .2 to .4 of them
    (python -m studies.sensors). A wrong scale is not a random walk, and is not covered.
    """

    #: Standard deviations on each axis after a metre [m] [deg]
    sigma_m: float = 0.03
    sigma_deg: float = 1.5
    #: A radian of rotation counts as this number of metres, since wheels then move, too
    metres_per_radian: float = 0.5
    #: Least deviations of each step, from stamps and interpolation [m] [deg]
    floor_m: float = 0.002
    floor_deg: float = 0.1

    def sigmas(self, distances_m: NDArray[np.float64], angles: NDArray[np.float64]
               ) -> NDArray[np.float64]:
        """Return deviations (m, 2) [m] [rad] after distances (m,) [m] and rotations (m,) [rad]."""
        ways = (distances_m + self.metres_per_radian * angles)[:, None]
        sigmas = np.hypot([self.floor_m, self.floor_deg],
                          np.sqrt(ways) * [self.sigma_m, self.sigma_deg])
        return np.asarray(sigmas * [1.0, np.radians(1.0)])


#: Classes of COCO that move by themselves, or are thrown or driven.
MOVING_CLASSES = (
    'person', 'bird', 'cat', 'dog', 'horse', 'sheep', 'cow', 'elephant', 'bear', 'zebra',
    'giraffe', 'sports ball', 'frisbee', 'kite', 'skateboard', 'car', 'motorcycle', 'airplane',
    'bus', 'train', 'truck', 'boat')


@dataclass(frozen=True)
class MappingOptions:
    """Options of mapping."""

    moving_classes: tuple[str, ...] = MOVING_CLASSES  #: These never become landmarks
    min_viewpoints: int = 3  #: A landmark needs support from this number of viewpoints
    #: Share of the frames showing a landmark's place in which it must be detected. Chance
    #: arrangements of boxes are seen rarely, but so are objects that others hide.
    min_seen_ratio: float = 0.03
    min_baseline_deg: float = 20.0  #: Least angle between two directions to a landmark [deg]
    #: Greatest deviation of a centre [m]; for large landmarks, see evidence.MAX_SIGMA_SHARE
    max_position_sigma_m: float = 0.08
    #: Refine the poses with the landmarks, given these errors; None: poses are exact
    pose_errors: PoseErrors | None = None
    #: Without pose_errors, estimate them, and refine the poses if they are significant
    estimate_pose_errors: bool = False
    #: Errors of the odometry between frames, which constrains the poses in their refinement
    odometry_errors: OdometryErrors = field(default_factory=OdometryErrors)
    refine_mount: bool = False  #: Correct the mount of the camera, which all poses share
    #: The coordinate frame and the origin that the map file names
    frame_id: str = 'map'
    source: str = 'build_map'
    random_seed: int = 0  #: Equal seed and input give equal output

    def moves(self, name: str) -> bool:
        """Return whether objects of a class move, whichever name a detector has for the class."""
        moving = set(map(str.lower, self.moving_classes))
        return name.lower() in moving or common_name(name) in moving


@dataclass(frozen=True)
class CheckOptions:
    """Options of a check."""

    #: Of the relocalizer that will use the map
    relocalizer: RelocalizerOptions = field(default_factory=RelocalizerOptions)
    folds: int = 5  #: Cross-validation: each fold is judged with landmarks fitted to the others
    frames: int = 100  #: Greatest number of recorded frames that are relocalized
    #: Spacing of the grid of camera positions [m]; increased if there are too many positions
    spacing_m: float = 0.5
    #: Greatest number of grid positions, and number of camera headings at each
    max_positions: int = 150
    headings: int = 12
    camera_height_m: float | None = None  #: Of the grid [m]; None: as in the recording
    use_vertical: bool = False  #: The relocalizer knows the vertical
    #: The recording is a folder, as of a phone, so that its poses are those of the camera itself
    of_folder: bool = False
    is_size_given: bool = False  #: The user gave the size of a class, so sizes tell no scale
    wrong_m: float = 1.0  #: An accepted pose farther off than this misleads a robot [m]
    random_seed: int = 0  #: Equal seed and input give equal output


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of shares, which determine the verdict on a map, see doc/trust.md. Chosen."""

    min_localized: Annotated[float, 'views that are localized'] = 0.4
    min_by_objects: Annotated[float, 'views that objects alone localize'] = 0.25
    min_by_keyframes: Annotated[float, 'views that keyframes alone localize'] = 0.4
    max_misled: Annotated[
        float, 'recorded and simulated views in which a wrong pose is accepted'] = 0.01
    max_systematic: Annotated[
        float, 'errors of boxes that a wrong camera, mount or clock explains'] = 0.25
