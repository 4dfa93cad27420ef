# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How to check a map, and what it has to reach."""

from dataclasses import dataclass, field

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.mapping.options import MappingOptions


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
    #: How boxes belong to landmarks, and how landmarks are fitted
    mapping: MappingOptions = field(default_factory=MappingOptions)
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
    max_faulty: float = 0.15  #: Share of the landmarks with a serious fault
    max_duplicates: int = 0  #: Pairs of landmarks that are one object
    max_look_alikes: int = 0  #: Pairs of places that a detector cannot tell apart
