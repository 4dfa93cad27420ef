# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How to relocalize: every choice the method leaves to its user."""

import math
from dataclasses import dataclass

from cliploc_ros.errors import OptionsError

MATCHINGS = ('class', 'clip', 'hybrid')
ALGORITHMS = ('auto', 'bf', 'ransac', 'prosac', 'b-prosac')


@dataclass(frozen=True)
class RelocalizerOptions:
    """Options of the method; the defaults are the paper's where the paper has one.

    Parameters
    ----------
    matching : str
        'class', 'clip' or 'hybrid': what makes a correspondence candidate.
    algorithm : str
        Which minimal samples are tried. 'bf', 'ransac', 'prosac' and 'b-prosac' are the paper's;
        'auto' tries every sample that boxes and map allow, in the order of b-prosac and without
        repetition, as far as `iterations` and `time_budget_s` reach. In hybrid matching it goes
        on to candidates of equal class when those of CLIP are done.
    k : int
        Landmarks retrieved for each crop, at least 1.
    iterations : int
        Minimal samples drawn, of auto the most that are tried; bf tries them all instead. The
        paper's 500 find the best pose less often, and then not its rivals either.
    iou_threshold : float
        A detection and a landmark that overlap more than this (0 to 1) are an inlier.
    random_seed : int
        Equal seed and input give equal output; below 0 every search differs.
    time_budget_s : float
        Association, search and refinement take no longer than this [s], to within 10 %; what
        is cut short, but for auto, is refused, and says how far it came. Results that it cuts
        depend on the machine: the iterations are there to end a search before. 10,000 took
        32 ms at most on the 258 recorded frames (40 landmarks, one idle core); crowded maps take
        longer.
    height_range_m : tuple of float
        The least and the greatest height of the camera in the map [m]; poses outside are left.
    max_tilt_deg : float
        How far the camera may be turned or tipped off upright [deg], 180 is any way; where the
        vertical is known, how far it may be off at a pose from three points.
    vertical_deviation_deg : float
        Standard deviation of a known vertical [deg], 1 sigma. Where one is known, auto samples
        two candidates in place of three.
    refine : bool
        Improve the best hypotheses on all of their inliers, before the best of them is chosen;
        the paper does not.
    min_inliers : int
        Fewer explained objects are refused.
    min_confidence : float
        A pose that is within 1 m of the truth with less probability is refused (0 to 1), see
        cliploc_ros.core.acceptance.confidence.

    Raises
    ------
    OptionsError
        Names the option and what it allows.
    """

    matching: str = 'hybrid'
    algorithm: str = 'auto'
    k: int = 3
    iterations: int = 10_000
    iou_threshold: float = 0.2
    random_seed: int = 0
    time_budget_s: float = math.inf
    height_range_m: tuple[float, float] = (-math.inf, math.inf)
    max_tilt_deg: float = 180.0
    vertical_deviation_deg: float = 1.0
    refine: bool = True
    min_inliers: int = 3
    min_confidence: float = 0.99

    def __post_init__(self) -> None:
        """Refuse values outside what each option allows."""
        _check_choice('matching', self.matching, MATCHINGS)
        _check_choice('algorithm', self.algorithm, ALGORITHMS)
        if self.matching == 'class' and 'prosac' in self.algorithm:
            raise OptionsError(f"algorithm '{self.algorithm}' orders candidates by similarity, "
                               "which matching 'class' has none of: use bf or ransac")
        _check_range('k', self.k, 1, math.inf)
        _check_range('iterations', self.iterations, 1, 1_000_000)
        _check_range('iou_threshold', self.iou_threshold, 0.0, 1.0)
        _check_range('time_budget_s', self.time_budget_s, 0.0, math.inf)
        _check_height_range(self.height_range_m)
        _check_range('max_tilt_deg', self.max_tilt_deg, 0.0, 180.0)
        _check_range('vertical_deviation_deg', self.vertical_deviation_deg, 0.01, 45.0)
        _check_range('min_inliers', self.min_inliers, 3, math.inf)
        _check_range('min_confidence', self.min_confidence, 0.0, 1.0)

    @property
    def needs_similarities(self) -> bool:
        """Return whether crops must be compared with labels."""
        return self.matching != 'class'


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise OptionsError(f"{name}: '{value}' is none of {', '.join(choices)}")


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise OptionsError(f'{name}: {value} must lie within {low:g} and {high:g}')


def _check_height_range(heights: tuple[float, float]) -> None:
    if len(heights) != 2 or not heights[0] < heights[1]:
        raise OptionsError(f'height_range_m: {list(heights)} must be a lower and a greater height')
