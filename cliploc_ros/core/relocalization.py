# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a relocalizer answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.fit.finalists import Match


@dataclass(frozen=True)
class Hypothesis:
    """A pose the camera may have had.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    score : float
        Sum of the IoUs that speak for it.
    confidence : float
        How likely it is within 1 m of the truth, 0 to 1.
    support : Support
        Why so.
    """

    map_from_camera: NDArray[np.float64]
    score: float
    confidence: float
    support: Support


@dataclass(frozen=True)
class Relocalization:
    """What a search found, and whether to believe it.

    Parameters
    ----------
    accepted : bool
        Whether the pose is to be acted on.
    reason : str
        Why not, in one line; empty when accepted.
    hypotheses : tuple of Hypothesis
        The distinct best, best first; empty when nothing was found.
    matches : tuple of Match
        The inliers of the best, in the frame that was asked about.
    covariance : ndarray (6, 6) or None
        Of the best, see cliploc_ros.core.fit.covariance; None when nothing was found.
    tried : int
        How many hypotheses were made.
    best_iteration : int
        In which iteration the best was found, from 1; 0 when nothing was found.
    coverage : float
        The share of its samples that the search could try in its time, 0 to 1.
    search_ms : float
        How long association, search and verification took [ms].
    stamp_ns : int
        Stamp of the observation [ns].
    """

    accepted: bool
    reason: str
    hypotheses: tuple[Hypothesis, ...] = ()
    matches: tuple[Match, ...] = ()
    covariance: NDArray[np.float64] | None = None
    tried: int = 0
    best_iteration: int = 0
    coverage: float = 1.0
    search_ms: float = 0.0
    stamp_ns: int = 0

    @property
    def solved(self) -> bool:
        """Return whether any pose was found, believed or not."""
        return bool(self.hypotheses)

    @property
    def map_from_camera(self) -> NDArray[np.float64] | None:
        """Return the best pose (4, 4), believed or not; None when there is none."""
        return self.hypotheses[0].map_from_camera if self.hypotheses else None

    @property
    def confidence(self) -> float:
        """Return how likely the best pose is within 1 m; 0 when nothing was found."""
        return self.hypotheses[0].confidence if self.hypotheses else 0.0

    @property
    def score(self) -> float:
        """Return the best score; 0 when nothing was found."""
        return self.hypotheses[0].score if self.hypotheses else 0.0
