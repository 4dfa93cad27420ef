# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How to update a map. All limits are guesses unless they say otherwise."""

from dataclasses import dataclass, field

from cliploc_ros.mapping.options import MappingOptions


@dataclass(frozen=True)
class UpdateOptions:
    """Options of an update."""

    #: How new landmarks are built; with its pose_errors, the poses are refined against the map
    mapping: MappingOptions = field(default_factory=MappingOptions)
    unknown_sigma_m: float = 0.05  #: Deviation of a centre where the map does not say it [m]
    #: An object has moved if it is farther away than all three: [m], in units of its old and new
    #: shape (1: they touch), and in standard deviations of both positions. A smaller change is a
    #: better fit.
    least_move_m: float = 0.1
    least_move_shapes: float = 0.6
    least_move_sigmas: float = 4.0
    #: A larger offset of the recording's coordinate frame from the map's is noted
    least_offset_m: float = 0.03
    least_offset_deg: float = 1.0
    stays: float = 0.9  #: Share of the objects that are usually still in their place
    #: Share of the views in which an object is detected, where neither map nor recording tell
    seen_ratio: float = 0.9
    #: So many views the seen ratio is worth at most, as an object may be hard to see from one side
    prior_views: float = 4.0
    #: Share of the views in which a wrong box appears in an empty place
    chance_ratio: float = 0.03
    #: An object is gone, or there, if the probability of being there is so small, or large
    gone_below: float = 0.05
    gone_below_if_taken: float = 0.5  #: The same where another object was found in its place
    there_above: float = 0.95
    #: Its place must be in view from this number of viewpoints before an object can be missing
    least_views: int = 5
    #: A place is in view if the frame shows another landmark this close to its direction, and not
    #: nearer: otherwise a wall may hide it
    beside_deg: float = 20.0
    hidden_share: float = 0.4  #: A place is out of view if landmarks or boxes hide this share
    #: A new landmark must be detected so often, in units of how often the old ones are
    min_new_share: float = 0.4
    min_confirmed: int = 3
    #: A recording that confirms fewer landmarks, or a smaller share of those whose place it shows,
    #: does not belong to the map
    min_confirmed_share: float = 0.3
