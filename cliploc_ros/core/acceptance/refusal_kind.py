# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of refusals: what programs compare and count, next to a reason for people."""

from enum import StrEnum, auto
from typing import NamedTuple


class RefusalKind(StrEnum):
    """Why a pose is refused."""

    #: Too few detections, candidates or matched objects for a pose.
    TOO_FEW_OBJECTS = auto()
    #: Another pose found is too likely.
    AMBIGUOUS = auto()
    #: The map has another place that looks the same.
    LOOK_ALIKE = auto()
    #: The covariance is too large.
    UNCERTAIN_POSITION = auto()
    #: What was matched is too weak, or too much of the image does not fit.
    UNEXPLAINED = auto()
    #: Too few samples to have met the rivals of the pose.
    SEARCH_CUT_SHORT = auto()
    #: Enough for all crops, but time ended before all were compared.
    NOT_ALL_CROPS = auto()
    #: The looks before this one were too unsure of the pose.
    FRAMES_DISAGREE = auto()
    #: Objects and keyframes lead to different places.
    CONTRADICTION = auto()
    #: Keyframes show signs of a picture of the place, of wrong intrinsics, or of a changed place.
    CHANGED = auto()
    #: The time of the request ended before a frame was localized.
    TIME_UP = auto()


class Refusal(NamedTuple):
    """A kind, and the reason in one line."""

    kind: RefusalKind
    reason: str
