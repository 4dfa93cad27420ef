# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The decision to accept or refuse the leading pose. A wrong pose is worse than none."""

import math
from dataclasses import KW_ONLY, dataclass, replace
from enum import StrEnum, auto
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.genuine import Motion, Signs, chance_genuine
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.options import RelocalizerOptions

# A refusal does not mention less likely rivals.
_LEAST_RIVAL = 0.001
_LOOK_ABOUT = 'turn the camera to more objects'
Point = tuple[float, float, float]


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
    #: Boxes, camera_info and map do not agree, or no look has verified that they do.
    WRONG_CAMERA = auto()
    #: The time of the request ended before a frame was localized.
    TIME_UP = auto()
    #: The map has none of the detector's classes, or no score or box is usable.
    WRONG_DETECTIONS = auto()


class Refusal(NamedTuple):
    """A kind, and the reason in one line."""

    kind: RefusalKind
    reason: str


@dataclass(frozen=True)
class Rival:
    """The likeliest pose that does not agree with the leading one."""

    likely: float  #: Its probability
    place: Point  #: Where its camera is [m]
    map: str = ''  #: Name of its map, where there are several
    #: Whether keyframes propose one of the two poses and objects the other
    is_other_source: bool = False


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against the leading pose."""

    inliers: int  #: Number of objects that it explains
    #: Probability that it is right, given all poses found, see
    #: cliploc_ros.core.acceptance.confidence
    likely: float
    _: KW_ONLY
    #: The same without the objects; 0 where keyframes do not propose it
    by_points: float = 0.0
    rival: Rival | None = None
    distinct: float = 1.0  #: Probability that its place is not mistaken for one that looks alike
    #: Where the camera is, and where it would be at the likeliest place that looks alike [m]
    place: Point = (0.0, 0.0, 0.0)
    twin: Point | None = None
    twin_map: str = ''  #: Name of the twin's map, where there are several
    near: float = 1.0  #: Probability that it is within 1 m if it is right, given its covariance
    #: By how much errors of a camera lower that, and what is certainly wrong with one; empty if
    #: nothing is, see cliploc_ros.core.acceptance.camera_check
    camera: float = 1.0
    camera_fault: str = ''
    deviation_m: float = 0.0  #: Standard deviation of its position [m]
    coverage: float = 1.0  #: Share of its samples that the search tried, 0 to 1
    tried: int = 0  #: Number of samples that the search tried
    #: Number of these samples that hold only inliers of the best pose of objects; infinite for a
    #: search that tried all samples
    meetings: float = math.inf
    unexplained: float = 0.0  #: Number of other detected objects of the map's classes
    #: That the place is there and no picture of it; None where keyframes do not propose it
    signs: Signs | None = None
    motion: Motion | None = None  #: Since an earlier look by keyframes
    #: Probability that the image is no mirror image, see cliploc_ros.core.acceptance.contenders
    not_mirrored: float = 1.0
    #: Probability that keyframes are wrong which recognize another place only
    uncontradicted: float = 1.0
    recognized: RecognizedPlace | None = None  #: What keyframes show at the pose
    prior: float = 0.0  #: Log odds, 0 or less, that a region known before gives the pose
    #: Confidence of each earlier look in this pose, see cliploc_ros.core.acceptance.looks
    earlier: tuple[float, ...] = ()
    crops_left: int = 0  #: Number of crops that were not compared with labels yet

    @property
    def found(self) -> float:
        """Return the probability that the search of objects has not missed a better pose.

        A rival with as many inliers is met about as often as the best pose. Random draws miss it
        with probability exp(-meetings) (Fischler and Bolles 1981). That holds for ransac. For
        auto and PROSAC, whose order is not random, it is an assumption.
        """
        return 1.0 - CALIBRATION.search.missed_is_right * math.exp(-self.meetings)

    @property
    def genuine(self) -> float:
        """Return the probability that the place is there, and no picture of it."""
        return 1.0 if self.signs is None else chance_genuine(self.signs, self.motion)

    @property
    def certainty(self) -> float:
        """Return the probability that nothing besides the poses found makes it wrong."""
        return (self.distinct * self.near * self.camera * self.genuine * self.not_mirrored
                * self.uncontradicted)

    @property
    def confidence(self) -> float:
        """Return the probability that the leading pose is within 1 m of the truth."""
        return max(self.likely * self.found, self.by_points) * self.certainty

    @property
    def with_right_camera(self) -> 'Evidence':
        """Return the evidence for the pose if all cameras are right."""
        return replace(self, camera=1.0, camera_fault='')

    @property
    def mean_confidence(self) -> float:
        """Return the mean confidence of all looks in this pose."""
        return (sum(self.earlier) + self.confidence) / (len(self.earlier) + 1)


def is_exhaustive(coverage: float, options: RelocalizerOptions) -> bool:
    """Return whether a search has tried every sample."""
    return coverage == 1.0 and options.algorithm in ('auto', 'bf')


def refusal(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return why the leading pose is refused; None if it is accepted.

    What the search of objects lacks does not matter where keyframes alone are sure enough.
    """
    by_points = evidence.by_points >= needed_confidence(evidence, options)
    if evidence.camera_fault and not by_points:
        return Refusal(RefusalKind.WRONG_CAMERA, f'{evidence.camera_fault}; check camera_info, '
                                                 'and the pixels and corners of the boxes')
    lacks = None if by_points else _too_short(evidence, options) or _too_few(evidence, options)
    return lacks or _too_unlikely(evidence, options) or _contradicted(evidence, options)


def needed_confidence(evidence: Evidence, options: RelocalizerOptions) -> float:
    """Return the confidence that a pose needs; more while crops are left.

    Each search with more crops is another chance of a false accept, as in the interim analyses of
    clinical trials (Haybittle, "Repeated assessment of results in clinical trials of cancer
    treatment", 1971). That holds for a search that time ends, too.
    """
    if not evidence.crops_left:
        return options.min_confidence
    return 1.0 - CALIBRATION.search.early_share * (1.0 - options.min_confidence)


def _too_short(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    kind, least = RefusalKind.SEARCH_CUT_SHORT, int(CALIBRATION.search.least_samples)
    if evidence.coverage < 1.0 and options.algorithm == 'auto':
        if evidence.tried < least:
            return Refusal(kind, f'search stopped after {evidence.tried} < {least} '
                                 'hypotheses; raise the time budget and iterations')
    elif evidence.coverage < 1.0:
        return Refusal(kind, f'search stopped after {100 * evidence.coverage:.3g} % of the '
                             'samples; raise the time budget or set algorithm to auto')
    elif options.algorithm not in ('auto', 'bf') and options.iterations < least:
        return Refusal(kind, f'iterations {options.iterations} < {least}, too few to '
                             f'find rivals; set iterations to {least} or more')
    return None


def _too_few(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    if evidence.inliers >= options.min_inliers:
        return None
    return Refusal(RefusalKind.TOO_FEW_OBJECTS,
                   f'{evidence.inliers} objects matched < {options.min_inliers}'
                   f'{_points(evidence)}; {_LOOK_ABOUT}')


def _too_unlikely(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return a refusal that names the evidence which takes most of the missing probability."""
    confidence, needed = evidence.confidence, needed_confidence(evidence, options)
    if confidence >= needed:
        return None
    if confidence >= options.min_confidence:
        digits = 1 + math.ceil(-math.log10(1.0 - needed))
        return Refusal(RefusalKind.NOT_ALL_CROPS,
                       f'confidence {_rounded_down(confidence, digits)} < {needed:.{digits}f}, as '
                       f'it takes without {evidence.crops_left} crops; raise timeout_s')
    compared = f'confidence {_rounded_down(confidence)} < {options.min_confidence:g}'
    if evidence.prior < 0.0:
        compared += '; the prior has the robot elsewhere'
    likely = max(evidence.likely, evidence.by_points)
    found = max(evidence.likely * evidence.found, evidence.by_points) / max(likely, 1e-9)
    weakest = min({'likely': likely, 'distinct': evidence.distinct, 'near': evidence.near,
                   'camera': evidence.camera, 'genuine': evidence.genuine,
                   'mirror': evidence.not_mirrored, 'keyframes': evidence.uncontradicted,
                   'found': found}.items(),
                  key=lambda item: item[1])[0]
    # the twin may be among the rivals, too
    if evidence.twin is not None and evidence.distinct < options.min_confidence and (
            weakest == 'distinct' or (weakest == 'likely' and _is_ambiguous(evidence))):
        second = evidence.twin_map and f' (the second in {evidence.twin_map})'
        return Refusal(RefusalKind.LOOK_ALIKE,
                       f'{compared}; {_point(evidence.place)} and {_point(evidence.twin)} m look '
                       f'alike{second}; turn the camera to objects that differ')
    if weakest == 'near':
        return Refusal(RefusalKind.UNCERTAIN_POSITION,
                       f'{compared}; position uncertain by {evidence.deviation_m:.2g} m; '
                       'turn the camera to more or nearer objects')
    if weakest == 'camera':
        return Refusal(RefusalKind.WRONG_CAMERA,
                       f'{compared}; another focal length or other pixels of the boxes may fit; '
                       'turn the camera to nearer objects, or check camera_info')
    if weakest == 'genuine' and evidence.recognized is not None:
        return Refusal(RefusalKind.CHANGED,
                       f'{compared}; {evidence.recognized.inliers} points of keyframes agree as '
                       'in a picture or a changed place; move, and ask again')
    if weakest == 'mirror':
        return Refusal(RefusalKind.AMBIGUOUS, f'{compared}; mirrored, the image fits another '
                                              'pose; turn the camera to more objects')
    if weakest == 'found':
        return Refusal(RefusalKind.SEARCH_CUT_SHORT,
                       f'{compared}; pose met only {evidence.meetings:g} times in '
                       f'{evidence.tried} samples; raise iterations or set algorithm to auto')
    return _unsure(evidence, compared, weakest == 'keyframes')


def _unsure(evidence: Evidence, compared: str, by_keyframes: bool) -> Refusal:
    """Return the refusal of a pose that others rival, or that too little supports."""
    rival = evidence.rival
    if rival is None or not (by_keyframes or _is_ambiguous(evidence)):
        return Refusal(RefusalKind.UNEXPLAINED,
                       f'{compared}; {evidence.inliers} objects matched, '
                       f'{round(evidence.unexplained)} unexplained{_points(evidence)}; '
                       f'{_LOOK_ABOUT}')
    if rival.is_other_source or by_keyframes:
        apart = float(np.linalg.norm(np.subtract(rival.place, evidence.place)))
        return Refusal(RefusalKind.CONTRADICTION,
                       f'{compared}; objects and keyframes lead {apart:.2f} m apart; '
                       f'{_LOOK_ABOUT}')
    where = f' in {rival.map}' if rival.map else ''
    return Refusal(RefusalKind.AMBIGUOUS,
                   f'{compared}; ambiguous, another pose has {rival.likely:.2g}{where}; '
                   'turn the camera to objects that differ')


def _is_ambiguous(evidence: Evidence) -> bool:
    """Return whether a rival has most of the missing probability, or nearly that of the pose."""
    return evidence.rival is not None and evidence.rival.likely > max(
        _LEAST_RIVAL, min(0.9 * evidence.likely, 0.5 * (1.0 - evidence.likely)))


def _contradicted(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return a refusal if the looks before this one were too unsure of this pose."""
    needed = min(CALIBRATION.looks.mean_confidence, options.min_confidence)
    if evidence.mean_confidence >= needed:
        return None
    return Refusal(RefusalKind.FRAMES_DISAGREE,
                   f'mean confidence {_rounded_down(evidence.mean_confidence)} < {needed:g} of '
                   f'the last {len(evidence.earlier) + 1} frames in this pose; {_LOOK_ABOUT}')


def _points(evidence: Evidence) -> str:
    """Return what keyframes show at the pose, as a part of a sentence; empty without any."""
    if evidence.recognized is None:
        return ''
    return (f', {evidence.recognized.inliers} points of keyframes agree in '
            f'{evidence.recognized.confirmed:.0%} of the image')


def _point(position: Point) -> str:
    return f'({position[0]:.1f}, {position[1]:.1f}, {position[2]:.1f})'


def _rounded_down(share: float, digits: int = 2) -> str:
    """Return some decimals, never rounded up: 0.9899 stays below 0.99."""
    return f'{math.floor(share * 10**digits + 1e-9) / 10**digits:.{digits}f}'
