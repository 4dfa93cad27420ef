# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether to believe the best pose. A wrong pose is worse than none."""

import math
from dataclasses import dataclass

from cliploc_ros.core.options import RelocalizerOptions

# Fewer samples have not looked for rivals: the confidence would mean nothing.
_MIN_ITERATIONS = 500
# Of likely poses that a search had met once or never, at most so many were wrong.
_MISSED_IS_RIGHT = 0.2


@dataclass(frozen=True)
class Evidence:
    """What speaks for the best hypothesis, and what against it.

    Parameters
    ----------
    inliers : int
        Objects that the best explains.
    likely : float
        How likely it is right, of all that were found, see cliploc_ros.core.acceptance.confidence.
    rival : float
        The same of the likeliest other hypothesis; 0 when there is none.
    coverage : float
        The share of its samples that the search tried, 0 to 1.
    tried : int
        How many these are.
    meetings : float
        How many samples, of those that the search tried, hold nothing but inliers of the best
        hypothesis; infinite of a search that tried all.
    unexplained : float
        Other objects of the map's classes, see cliploc_ros.core.acceptance.confidence.
    """

    inliers: int
    likely: float
    rival: float = 0.0
    coverage: float = 1.0
    tried: int = 0
    meetings: float = math.inf
    unexplained: float = 0.0

    @property
    def found(self) -> float:
        """Return how likely the search has not missed what is right in place of the best.

        A rival with as many inliers is met about as often, so it is missed with a chance of about
        exp(-meetings) (Fischler and Bolles 1981).
        """
        return 1.0 - _MISSED_IS_RIGHT * math.exp(-self.meetings)

    @property
    def confidence(self) -> float:
        """Return how likely the best hypothesis is right, of all that there may be."""
        return self.likely * self.found


def is_exhaustive(coverage: float, options: RelocalizerOptions) -> bool:
    """Return whether a search has tried every sample."""
    return coverage == 1.0 and options.algorithm in ('auto', 'bf')


def refusal(evidence: Evidence, options: RelocalizerOptions) -> str:
    """Return why the best hypothesis is not to be believed; empty if it is."""
    if evidence.coverage < 1.0 and options.algorithm == 'auto':
        if evidence.tried < _MIN_ITERATIONS:
            return (f'the search was cut short after {evidence.tried} hypotheses, too few to know '
                    f'the rivals of a pose: raise the time budget and iterations')
    elif evidence.coverage < 1.0:
        return (f'the search was cut short after {100 * evidence.coverage:.3g} %, so a better '
                'pose may be elsewhere: raise the time budget, or set algorithm to auto')
    elif options.algorithm not in ('auto', 'bf') and options.iterations < _MIN_ITERATIONS:
        return (f'iterations = {options.iterations} are too few to know the rivals of a pose: '
                f'set at least {_MIN_ITERATIONS}')
    if evidence.inliers < options.min_inliers:
        return (f'only {evidence.inliers} objects are where the map has them, '
                f'{options.min_inliers} are needed: turn to where more are in view')
    if evidence.confidence >= options.min_confidence:
        return ''
    if evidence.likely >= options.min_confidence:
        return (f'the search met this pose only {evidence.meetings:g} times in {evidence.tried} '
                'samples, so one as good may have been missed: raise iterations, or set '
                'algorithm to auto')
    says = f'{_percent(evidence.confidence)}, {_percent(options.min_confidence)} are asked for'
    # where a rival holds most of what is missing, or is the likelier
    if evidence.rival > min(evidence.likely, 0.5 * (1.0 - evidence.likely)):
        return (f'ambiguous: the best pose is right with {says}, another with '
                f'{_percent(evidence.rival)}: turn to where more can be told apart')
    others = round(evidence.unexplained)
    unlike = f' ({others} more are where the map has none: is it this place?)' if others else ''
    return (f'unsure: {evidence.inliers} objects{unlike} make the best pose right with {says}: '
            'turn to where more are in view')


def _percent(share: float) -> str:
    """Return a percentage that is never rounded up to another hundredth."""
    return f'{math.floor(share * 1000) / 10:g} %'
