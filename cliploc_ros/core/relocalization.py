# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a relocalization."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraLook
from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.acceptance.depth_check import DepthCheck
from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.map.joined_map import MapPart, parts_of, place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap


@dataclass(frozen=True)
class Hypothesis:
    """A possible pose of the camera."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    score: float  #: Sum of the IoUs of its inliers
    #: Probability that it is within 1 m of the truth, 0 to 1. Each position is taken for as
    #: uncertain as that of the best hypothesis.
    confidence: float
    support: Support  #: Basis of the confidence
    #: Log odds that its attitude takes from it, see cliploc_ros.core.acceptance.confidence
    handicap: float = 0.0


@dataclass(frozen=True)
class Relocalization:
    """The hypotheses of a relocalization, and whether the best one is accepted."""

    accepted: bool  #: Whether to act on the pose
    reason: str  #: Reason of a refusal, in one line; empty when accepted
    #: The best distinct hypotheses, best first; empty when nothing was found
    hypotheses: tuple[Hypothesis, ...] = ()
    #: Inliers of the best hypothesis in each frame, the newest last; empty when nothing was found
    frame_matches: tuple[tuple[Match, ...], ...] = ()
    #: Evidence for the best hypothesis, which decided; None when nothing was found
    evidence: Evidence | None = None
    #: (6, 6): of the best hypothesis, see cliploc_ros.core.fit.covariance; None when nothing was
    #: found
    covariance: NDArray[np.float64] | None = None
    tried: int = 0  #: Number of hypotheses tried
    #: Iteration that found the best hypothesis, from 1; 0 when nothing was found
    best_iteration: int = 0
    coverage: float = 1.0  #: Share of its samples that the search tried, 0 to 1
    search_ms: float = 0.0  #: Time of association, search and verification [ms]
    stamp_ns: int = 0  #: Stamp of the newest observation [ns]
    source: str = 'objects'  #: What proposes the best pose: 'objects', 'keyframes' or 'both'
    #: Kind of the refusal, which programs compare; None when accepted
    refusal_kind: RefusalKind | None = None
    #: What keyframes say, whatever the best pose comes from; None without keyframes
    recognition: Recognition | None = None
    #: Whether the depths of the objects can be right; None without depth
    depth: DepthCheck | None = None
    #: What a pose that depends on boxes, and is accepted with right cameras, says of the cameras
    cameras: tuple[CameraLook, ...] = ()

    @property
    def matches(self) -> tuple[Match, ...]:
        """Return the inliers of the best hypothesis in the newest frame."""
        return self.frame_matches[-1] if self.frame_matches else ()

    @property
    def recognized(self) -> RecognizedPlace | None:
        """Return the first place that keyframes recognize; None without one."""
        return self.recognition.places[0] if self.recognition and self.recognition.places else None

    @property
    def solved(self) -> bool:
        """Return whether any pose was found, accepted or not."""
        return bool(self.hypotheses)

    @property
    def map_from_camera(self) -> NDArray[np.float64] | None:
        """Return the best pose (4, 4), accepted or not; None when there is none."""
        return self.hypotheses[0].map_from_camera if self.hypotheses else None

    @property
    def confidence(self) -> float:
        """Return the probability that the best pose is within 1 m; 0 when nothing was found."""
        return self.hypotheses[0].confidence if self.hypotheses else 0.0

    @property
    def score(self) -> float:
        """Return the best score; 0 when nothing was found."""
        return self.hypotheses[0].score if self.hypotheses else 0.0


def in_its_map(found: Relocalization, landmark_map: LandmarkMap
               ) -> tuple[Relocalization, MapPart]:
    """Return a result in the coordinate frame of the map of its best pose, and this map.

    It was found in landmark_map, which may be a JoinedMap. Poses on other maps are left out: they
    have no place in this coordinate frame. The reason of a refusal names the map. A result from a
    single map stays as it is.
    """
    parts = parts_of(landmark_map)
    if found.map_from_camera is None or len(parts) == 1:
        return found, parts[0]
    places = [place_of(landmark_map, one.map_from_camera) for one in found.hypotheses]
    part, name = places[0].part, places[0].name
    rows = range(part.first, part.first + len(part.landmark_map))
    reason = found.reason and f'in {name}: {found.reason}'
    return replace(
        found, reason=reason,
        hypotheses=tuple(replace(one, map_from_camera=place.map_from_camera)
                         for one, place in zip(found.hypotheses, places, strict=True)
                         if place.name == name),
        frame_matches=tuple(tuple(replace(one, landmark=one.landmark - part.first)
                                  for one in of_frame if one.landmark in rows)
                            for of_frame in found.frame_matches)), part
