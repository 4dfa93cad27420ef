# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The decision to accept or refuse the best pose. A wrong pose is worse than none."""

import math
from dataclasses import dataclass

from cliploc_ros.core.acceptance.refusal_kind import Refusal, RefusalKind
from cliploc_ros.core.options import RelocalizerOptions

# A search that tried fewer samples has not looked for rivals: its confidence means nothing.
_MIN_ITERATIONS = 500
# Chance that a likely pose is wrong where the search hardly met it. A guess on the safe side: of
# the poses of likelihood .99 that 100 to 1,000 samples (ransac, b-prosac, auto) met once or never,
# 9 of 813 were wrong on the 258 TUM frames, which also fitted the confidence; 2 of 48 of ransac by
# classes in the demo. The default min_confidence takes two meetings.
_MISSED_IS_RIGHT = 0.6
# What the looks of a robot must give a pose on average. Of 156 robots in maps with exchanged
# places (TUM fr3) that accept a confidence of .5, 87 accepted a wrong pose within 20 looks; 48
# where most looks had to lead to the pose, 21 with this mean. On the true map 44, 41 and 39 of 52
# accepted.
_MEAN_CONFIDENCE = 0.5
# A refusal does not mention less likely rivals.
_LEAST_RIVAL = 0.001
_LOOK_ABOUT = 'turn the camera to more objects'


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against the best hypothesis.

    Parameters
    ----------
    inliers : int
        Number of objects that it explains.
    likely : float
        Probability that it is right, given the hypotheses found, see
        cliploc_ros.core.acceptance.confidence.
    rival : float
        Probability that the likeliest hypothesis that does not agree with it is right instead; 0
        without one.
    distinct : float
        Probability that its place is not mistaken for one that looks alike.
    place, twin : tuple of float, optional
        Where the camera is, and where it would be at the likeliest place that looks alike [m].
    near : float
        Probability that it is within 1 m if it is right, given its covariance.
    deviation_m : float
        Standard deviation of its position [m].
    coverage : float
        Share of its samples that the search tried, 0 to 1.
    tried : int
        Number of samples that the search tried.
    meetings : float
        Number of these samples that hold only inliers of the best hypothesis; infinite for a
        search that tried all samples.
    unexplained : float
        Number of other detected objects of the map's classes.
    earlier : tuple of float
        Confidence of each earlier look in this pose, see cliploc_ros.core.acceptance.looks.
    rival_map, twin_map : str
        Name of the map of the likeliest rival and of the twin, where there are several maps.
    """

    inliers: int
    likely: float
    rival: float = 0.0
    distinct: float = 1.0
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    twin: tuple[float, float, float] | None = None
    near: float = 1.0
    deviation_m: float = 0.0
    coverage: float = 1.0
    tried: int = 0
    meetings: float = math.inf
    unexplained: float = 0.0
    earlier: tuple[float, ...] = ()
    rival_map: str = ''
    twin_map: str = ''

    @property
    def found(self) -> float:
        """Return the probability that the search has not missed a better pose.

        A rival with as many inliers is met about as often as the best pose. Random draws miss it
        with probability exp(-meetings) (Fischler and Bolles 1981). That holds for ransac. For
        auto and PROSAC, whose order is not random, it is an assumption: of the likely poses of
        auto that it met once or never, 1 of 93 was wrong, of the others 0 of 454 (100, 300 and
        1,000 samples; same frames as above).
        """
        return 1.0 - _MISSED_IS_RIGHT * math.exp(-self.meetings)

    @property
    def confidence(self) -> float:
        """Return the probability that the best hypothesis is within 1 m of the truth."""
        return self.likely * self.certainty

    @property
    def mean_confidence(self) -> float:
        """Return the mean confidence of all looks in this pose."""
        return (sum(self.earlier) + self.confidence) / (len(self.earlier) + 1)

    @property
    def certainty(self) -> float:
        """Return the probability that nothing besides the hypotheses found makes it wrong."""
        return self.distinct * self.found * self.near


def is_exhaustive(coverage: float, options: RelocalizerOptions) -> bool:
    """Return whether a search has tried every sample."""
    return coverage == 1.0 and options.algorithm in ('auto', 'bf')


def refusal(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return why the best hypothesis is refused; None if it is accepted."""
    return (_too_short(evidence, options) or _too_few(evidence, options)
            or _too_unlikely(evidence, options) or _contradicted(evidence, options))


def _too_short(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    kind = RefusalKind.SEARCH_CUT_SHORT
    if evidence.coverage < 1.0 and options.algorithm == 'auto':
        if evidence.tried < _MIN_ITERATIONS:
            return Refusal(kind, f'search stopped after {evidence.tried} < {_MIN_ITERATIONS} '
                                 'hypotheses; raise the time budget and iterations')
    elif evidence.coverage < 1.0:
        return Refusal(kind, f'search stopped after {100 * evidence.coverage:.3g} % of the '
                             'samples; raise the time budget or set algorithm to auto')
    elif options.algorithm not in ('auto', 'bf') and options.iterations < _MIN_ITERATIONS:
        return Refusal(kind, f'iterations {options.iterations} < {_MIN_ITERATIONS}, too few to '
                             f'find rivals; set iterations to {_MIN_ITERATIONS} or more')
    return None


def _too_few(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    if evidence.inliers >= options.min_inliers:
        return None
    return Refusal(RefusalKind.TOO_FEW_OBJECTS, f'{evidence.inliers} objects matched < '
                                                f'{options.min_inliers}; {_LOOK_ABOUT}')


def _too_unlikely(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    if evidence.confidence >= options.min_confidence:
        return None
    compared = f'confidence {_rounded_down(evidence.confidence)} < {options.min_confidence:g}'
    # the rival holds most of the missing probability, or is about as likely as the pose
    is_ambiguous = evidence.rival > max(_LEAST_RIVAL, min(0.9 * evidence.likely,
                                                          0.5 * (1.0 - evidence.likely)))
    others = evidence.likely * evidence.found * evidence.near
    if (evidence.twin is not None and evidence.distinct < options.min_confidence
            and (is_ambiguous or others >= options.min_confidence)):
        second = evidence.twin_map and f' (the second in {evidence.twin_map})'
        return Refusal(RefusalKind.LOOK_ALIKE,
                       f'{compared}; {_point(evidence.place)} and {_point(evidence.twin)} m look '
                       f'alike{second}; turn the camera to objects that differ')
    if evidence.likely * evidence.distinct * evidence.found >= options.min_confidence:
        return Refusal(RefusalKind.UNCERTAIN_POSITION,
                       f'{compared}; position uncertain by {evidence.deviation_m:.2g} m; '
                       'turn the camera to more or nearer objects')
    if evidence.likely >= options.min_confidence:
        return Refusal(RefusalKind.SEARCH_CUT_SHORT,
                       f'{compared}; pose met only {evidence.meetings:g} times in '
                       f'{evidence.tried} samples; raise iterations or set algorithm to auto')
    if is_ambiguous:
        return Refusal(RefusalKind.AMBIGUOUS,
                       f'{compared}; ambiguous, another pose has {evidence.rival:.2g}'
                       f'{_in(evidence.rival_map)}; turn the camera to objects that differ')
    return Refusal(RefusalKind.UNEXPLAINED,
                   f'{compared}; {evidence.inliers} objects matched, '
                   f'{round(evidence.unexplained)} unexplained; {_LOOK_ABOUT}')


def _in(map_name: str) -> str:
    return f' in {map_name}' if map_name else ''


def _contradicted(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return a refusal if the looks before this one were too unsure of this pose."""
    needed = min(_MEAN_CONFIDENCE, options.min_confidence)
    if evidence.mean_confidence >= needed:
        return None
    return Refusal(RefusalKind.FRAMES_DISAGREE,
                   f'mean confidence {_rounded_down(evidence.mean_confidence)} < {needed:g} of '
                   f'the last {len(evidence.earlier) + 1} frames in this pose; {_LOOK_ABOUT}')


def _point(position: tuple[float, float, float]) -> str:
    return f'({position[0]:.1f}, {position[1]:.1f}, {position[2]:.1f})'


def _rounded_down(share: float) -> str:
    """Return two decimals, never rounded up: 0.9899 stays below 0.99."""
    return f'{math.floor(share * 100 + 1e-9) / 100:.2f}'
