# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The answer to a request, or to one frame in continuous mode."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from geometry_msgs.msg import PoseWithCovarianceStamped

from cliploc_ros.core.acceptance.refusal_kind import RefusalKind
from cliploc_ros.ros.inputs.robot_state import RobotState


class Verdict(StrEnum):
    """What became of a request."""

    #: The pose is accepted and, for a request, delivered.
    ACCEPTED = 'accepted'
    #: No pose is certain enough.
    REFUSED = 'refused'
    #: A pose is accepted but was not delivered: the robot moves, or nobody takes it.
    WITHHELD = 'withheld'
    #: There was nothing to decide on: no frame, a bad message, a node that is not active.
    FAILED = 'failed'


@dataclass(frozen=True)
class Answer:
    """A verdict, its reason and, where it is accepted, the pose.

    Parameters
    ----------
    verdict : Verdict
    detail : str
        The pose in words, or the reason for having none, in one line.
    pose : PoseWithCovarianceStamped or None
        None unless accepted.
    received_at : float
        When the image arrived (monotonic clock) [s]; -inf without one.
    state : RobotState or None
        What the robot knew at the stamp of the image; None without an image.
    is_cut : bool
        Whether time was too short for all crops, which could have changed the verdict.
    stages_ms : mapping of str to float
        How long each stage took [ms].
    map_hash : str
        Of the map that was searched, see cliploc_ros.ros.map_hash; empty without one.
    kind : RefusalKind or None
        Of a refusal; None for other verdicts.
    """

    verdict: Verdict
    detail: str
    pose: PoseWithCovarianceStamped | None = None
    received_at: float = -math.inf
    state: RobotState | None = None
    is_cut: bool = False
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    map_hash: str = ''
    kind: RefusalKind | None = None

    @property
    def is_linked(self) -> bool:
        """Return whether odometry links the frame with those before and after it."""
        return self.state is not None and self.state.place is not None

    @property
    def message(self) -> str:
        """Return the verdict, its reason, the kind of a refusal and the map in one line."""
        text = self.detail if self.verdict is Verdict.FAILED else f'{self.verdict}: {self.detail}'
        if self.kind is not None:
            text = f'{text}; kind {self.kind}'
        return f'{text}; map {self.map_hash}' if self.map_hash else text
