# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The choices that building and checking a map leave to their user."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.vocabulary.vocabulary import common_name

#: Frames this near in time are of one instant [s], and the share of a pose's error that they have
#: in common where errors have no time constant.
INSTANT_S, _KEPT_AT_ONCE = 1e-3, 0.999


@dataclass(frozen=True)
class PoseErrors:
    """How the errors of given poses behave."""

    #: Standard deviations on each axis [m] [deg]
    sigma_m: float
    sigma_deg: float
    #: Time constant with which an error forgets itself [s]; 0: every frame errs on its own
    correlation_s: float = 3.0

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviations (6,) [m] [rad]."""
        return np.repeat([self.sigma_m, np.radians(self.sigma_deg)], 3)

    def kept(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of an error that is left after times (n,) [s].

        Frames of one instant are of several cameras of one robot, and err alike.
        """
        if self.correlation_s > 0.0:
            return np.asarray(np.exp(-seconds / self.correlation_s))
        return np.where(seconds <= INSTANT_S, _KEPT_AT_ONCE, 0.0)


@dataclass(frozen=True)
class OdometryErrors:
    """How the errors of odometry grow, as a random walk.

    All defaults are guesses; the angle of a Husky's wheels is off by .2 to .4 of them (python -m
    studies.sensors). A wrong scale is no random walk, and is not covered.
    """

    #: Standard deviations on each axis after a metre [m] [deg]
    sigma_m: float = 0.03
    sigma_deg: float = 1.5
    #: A radian of turning counts as this number of metres: wheels move then, too
    metres_per_radian: float = 0.5
    #: Of each step, for stamps and interpolation [m] [deg]
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


#: Classes of COCO that leave their place by themselves, or are thrown and driven.
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
    min_baseline_deg: float = 20.0  #: Least angle between two of its directions [deg]
    #: Greatest deviation of a centre [m]; of a large landmark, see evidence.MAX_SIGMA_SHARE
    max_position_sigma_m: float = 0.08
    #: Refine the poses with the landmarks, as far as they may be off; None: poses are exact
    pose_errors: PoseErrors | None = None
    #: Without pose_errors, estimate them, and refine the poses where they are significant
    estimate_pose_errors: bool = False
    #: Of odometry between frames, which joins the poses while they are refined
    odometry_errors: OdometryErrors = _ODOMETRY_ERRORS
    refine_mount: bool = False  #: Correct the mount of the camera, which all poses share
    #: What the map says of itself: its coordinate frame, and where it comes from
    frame_id: str = 'map'
    source: str = 'build_map'
    random_seed: int = 0  #: Equal seed and input give equal output

    def moves(self, name: str) -> bool:
        """Return whether objects of a class move, under whatever name a detector has for it."""
        moving = set(map(str.lower, self.moving_classes))
        return name.lower() in moving or common_name(name) in moving


@dataclass(frozen=True)
class CheckOptions:
    """Options of a check.

    Raises
    ------
    OptionsError
        Names the option and what it allows.
    """

    #: Of the relocalizer that will use the map
    relocalizer: RelocalizerOptions = field(default_factory=RelocalizerOptions)
    folds: int = 5  #: Cross-validation: each fold is judged with landmarks fitted to the others
    #: Folds take blocks of this length in turn [s]; a fold is not fitted to frames this near to
    #: one that it judges [s]
    block_s: float = 4.0
    gap_s: float = 1.0
    frames: int = 100  #: The most recorded frames that are relocalized
    #: Of the grid of camera positions [m]; larger where there would be too many positions
    spacing_m: float = 0.5
    #: The most positions of the grid, and the directions in which the camera looks at each
    max_positions: int = 150
    headings: int = 12
    camera_height_m: float | None = None  #: Of the grid [m]; None: as in the recording
    use_vertical: bool = False  #: The relocalizer knows the vertical
    wrong_m: float = 1.0  #: An accepted pose farther off than this misleads a robot [m]
    random_seed: int = 0  #: Equal seed and input give equal output

    def __post_init__(self) -> None:
        """Refuse values that an option does not allow."""
        for name, low, high in (('folds', 2, 100), ('frames', 1, 1_000_000),
                                ('max_positions', 1, 100_000), ('headings', 1, 360),
                                ('spacing_m', 0.01, 1e4), ('block_s', 1e-3, 1e6)):
            if not low <= getattr(self, name) <= high:
                raise OptionsError(f'{name}: {getattr(self, name)} must lie within {low:g} and '
                                   f'{high:g}')


@dataclass(frozen=True)
class Thresholds:
    """What a map has to reach. The values are guesses from a few maps of one office."""

    #: Held-out share of the boxes that a landmark of their class explains, and their median IoU
    min_explained: float = 0.6
    min_iou: float = 0.6
    min_accepted: float = 0.4  #: Share of the recorded frames that the relocalizer accepts
    #: Share of the recorded frames and grid views in which it accepts a wrong pose
    max_misled: float = 0.01
    #: Share of the grid positions near the recording in which it accepts some heading
    min_positions: float = 0.4
    #: The same by objects alone, where keyframes carry the rest; below, it is a map of keyframes
    min_by_objects: float = 0.1
    #: Share of the landmarks with a serious fault, each counted as often as it was seen
    max_faulty: float = 0.15
    max_duplicates: int = 0  #: Pairs of landmarks that are one object
    max_look_alikes: int = 0  #: Pairs of places that a detector cannot tell apart
