# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The time budget of one relocalization: when each of its stages ends."""

import time
from dataclasses import dataclass

# Shares of the budget at which the search and the refinement end; acceptance takes the rest.
_SEARCH_SHARE, _REFINEMENT_SHARE = 0.8, 0.9
# Both end earlier by this time [s] for each frame, up to five, since poses are scored and compared
# on all frames. A budget below _SHORT_BUDGET_S scales these times down.
_EARLIER_SEARCH_S, _EARLIER_REFINEMENT_S, _SHORT_BUDGET_S = 0.0065, 0.003, 0.05
_MOST_FRAMES = 5


@dataclass(frozen=True)
class TimeBudget:
    """A time budget that runs from `start`. All times are those of time.perf_counter [s].

    Parameters
    ----------
    start : float
    total_s : float
        Infinite for no limit.
    frames : int
        Number of frames that are localized together.
    """

    start: float
    total_s: float
    frames: int

    @staticmethod
    def begin(total_s: float, frames: int) -> 'TimeBudget':
        """Return a budget that starts now."""
        return TimeBudget(time.perf_counter(), total_s, frames)

    def search_end(self, number: int = 1, count: int = 1) -> float:
        """Return when the search of a frame ends: the number-th of count frames to search."""
        return self.start + self._time_s(_SEARCH_SHARE, _EARLIER_SEARCH_S) * number / count

    @property
    def refinement_end(self) -> float:
        """Return when the refinement ends."""
        return self.start + self._time_s(_REFINEMENT_SHARE, _EARLIER_REFINEMENT_S)

    @property
    def elapsed_ms(self) -> float:
        """Return the time since the start [ms]."""
        return (time.perf_counter() - self.start) * 1e3

    def _time_s(self, share: float, earlier_s: float) -> float:
        scale = min(1.0, self.total_s / _SHORT_BUDGET_S)
        frames = min(self.frames, _MOST_FRAMES)
        return share * self.total_s - scale * earlier_s * frames
