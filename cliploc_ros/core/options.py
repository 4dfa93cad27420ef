# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of the method."""

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

from cliploc_ros.errors import OptionsError

MATCHINGS = ('class', 'clip', 'hybrid')
#: What crops are compared with: the text labels of the map, its images, or both.
COMPARED = ('text', 'image', 'both')
ALGORITHMS = ('auto', 'bf', 'ransac', 'prosac', 'b-prosac')
#: Which crops of a frame are compared with labels.
CROPS = ('all', 'on_demand')
_CHOICES = {'matching': MATCHINGS, 'algorithm': ALGORITHMS, 'crops': CROPS}
_RANGES = {'k': (1, math.inf), 'iterations': (1, 1_000_000), 'iou_threshold': (0.0, 1.0),
           'time_budget_s': (0.0, math.inf), 'max_tilt_deg': (0.0, 180.0),
           'tilt_deviation_deg': (0.1, 60.0), 'vertical_deviation_deg': (0.01, 45.0),
           'min_inliers': (3, math.inf), 'min_confidence': (0.0, 1.0)}


class Deadline(NamedTuple):
    """The end of a search.

    Time without a processor does not count, so other programs do not shorten a search. A search
    that gets too little processor time ends with its request.
    """

    used_s: float = math.inf  #: By the processor time of the thread that searches [s]
    request: float = math.inf  #: When its request needs the result (monotonic clock) [s]

    @property
    def is_over(self) -> bool:
        """Return whether the search must end."""
        return time.thread_time() > self.used_s or time.monotonic() > self.request


#: The end of a search without limits.
NEVER = Deadline()


@dataclass(frozen=True)
class RelocalizerOptions:
    """Options of the method. The defaults are those of the paper if it states a value.

    Raises
    ------
    OptionsError
        An option has an invalid value; the message states the option and the valid values.
    """

    #: 'class', 'clip' or 'hybrid': which pairs are correspondence candidates
    matching: str = 'hybrid'
    #: Which minimal samples are tried. 'bf', 'ransac', 'prosac' and 'b-prosac' are the algorithms
    #: of the paper. 'auto' tries all samples that boxes and map allow, in the order of b-prosac
    #: and without repetition, until `iterations` or `time_budget_s` is reached. In hybrid
    #: matching, it continues with candidates of equal class after those of CLIP.
    algorithm: str = 'auto'
    k: int = 3  #: Number of landmarks retrieved for each crop, at least 1
    #: Number of minimal samples drawn; for auto the maximum number; bf ignores it. With the
    #: paper's 500, the search finds the best pose and its rivals less often.
    iterations: int = 10_000
    #: A detection is an inlier of a landmark if their IoU exceeds this, 0 to 1
    iou_threshold: float = 0.2
    random_seed: int = 0  #: Equal seed and input give equal output. If negative, searches differ.
    #: Limit of the processor time for association, search and refinement [s], kept to within 10 %,
    #: see Deadline. A search that exceeds it is refused, except for auto. Such results depend
    #: on the machine, so iterations should end a search first: 10,000 took at most 32 ms on the
    #: 258 recorded frames (40 landmarks, one idle core). Crowded maps take longer.
    time_budget_s: float = math.inf
    #: Minimum and maximum height of the camera in the map [m]; other poses are dropped
    height_range_m: tuple[float, float] = (-math.inf, math.inf)
    #: Maximum tilt of the camera against upright [deg]; 180 allows any pose. If the vertical is
    #: known, this limits the tilt of poses from three points against that vertical.
    max_tilt_deg: float = 180.0
    #: Standard deviation of the camera's tilt against upright [deg], see
    #: cliploc_ros.core.acceptance.confidence. It affects the confidence if no vertical is known.
    #: 0: all attitudes are equally likely, as in a map whose z axis is not up.
    tilt_deviation_deg: float = 40.0
    #: Standard deviation of a known vertical [deg]. If the vertical is known, auto samples two
    #: candidates instead of three.
    vertical_deviation_deg: float = 1.0
    #: Refine the best hypotheses on all their inliers, then choose the most likely pose. The paper
    #: does not refine, and chooses the pose with the greatest score.
    refine: bool = True
    #: Standard deviations of the mounts of several cameras relative to each other, on each axis
    #: [m] [deg]
    mount_deviation: tuple[float, float] = (0.01, 0.5)
    min_inliers: int = 3  #: A pose with fewer matched objects is refused
    #: A pose is refused if the probability that it is within 1 m of the truth is lower than this,
    #: 0 to 1, see cliploc_ros.core.acceptance.confidence
    min_confidence: float = 0.9
    #: 'all' or 'on_demand': which crops are compared with labels, see cliploc_ros.core.localizer.
    #: Only hybrid_auto uses this.
    crops: str = 'on_demand'

    def __post_init__(self) -> None:
        """Raise OptionsError for invalid values."""
        for name, choices in _CHOICES.items():
            if (chosen := getattr(self, name)) not in choices:
                raise OptionsError(f"{name}: '{chosen}' is none of {', '.join(choices)}")
        if self.matching == 'class' and 'prosac' in self.algorithm:
            raise OptionsError(f"algorithm '{self.algorithm}' needs similarities, but matching "
                               "'class' has none: set algorithm to auto, bf or ransac")
        for name, (low, high) in _RANGES.items():
            or_0 = ', or be 0' if name == 'tilt_deviation_deg' else ''
            if not low <= (value := getattr(self, name)) <= high and not (or_0 and value == 0.0):
                raise OptionsError(f'{name}: {value} must lie within {low:g} and {high:g}{or_0}')
        heights = self.height_range_m
        if len(heights) != 2 or not heights[0] < heights[1]:
            raise OptionsError(f'height_range_m: {list(heights)} must be a lower and a higher '
                               'height')
        mounts = self.mount_deviation
        if len(mounts) != 2 or not all(0.0 <= mount <= 1e3 for mount in mounts):
            raise OptionsError(f'mount_deviation: {list(mounts)} must be two numbers, 0 to 1000')

    @property
    def needs_similarities(self) -> bool:
        """Return whether crops must be compared with labels."""
        return self.matching != 'class'
