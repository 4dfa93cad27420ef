# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The decision to accept or refuse the leading pose. A wrong pose is worse than none."""

import math
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum, auto
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.acceptance.genuine import Motion, Signs, chance_genuine
from cliploc_ros.core.acceptance.looks import EarlierLook
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.tag_pose import TagPlace
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.options import RelocalizerOptions

_LOOK_ABOUT = 'turn the camera to more objects'
Point = tuple[float, float, float]


class RefusalKind(StrEnum):
    """The kinds of refusals of a pose."""

    #: There are too few detections, candidates or matched objects for a pose.
    TOO_FEW_OBJECTS = auto()
    #: The search found another pose that is too likely.
    AMBIGUOUS = auto()
    #: The map has another place that looks the same.
    LOOK_ALIKE = auto()
    #: The covariance is too large.
    UNCERTAIN_POSITION = auto()
    #: The matches are too weak, or too much of the image does not fit.
    UNEXPLAINED = auto()
    #: The search tried too few samples to find the rivals of the pose.
    SEARCH_CUT_SHORT = auto()
    #: The confidence is too low for a pose from a part of the crops, and time is up.
    NOT_ALL_CROPS = auto()
    #: The confidence of earlier looks in the pose is too low.
    FRAMES_DISAGREE = auto()
    #: Objects and keyframes lead to different places.
    CONTRADICTION = auto()
    #: Keyframes show signs of a picture of the place, of wrong intrinsics, or of a changed place.
    CHANGED = auto()
    #: Boxes, camera_info and map do not agree, or no look has verified that they do.
    WRONG_CAMERA = auto()
    #: The robot would lie on its side or head: the mount or the image is turned.
    WRONG_MOUNT = auto()
    #: The request timed out before a frame was localized.
    TIME_UP = auto()
    #: The map has none of the detector's classes, or no score or box is usable.
    WRONG_DETECTIONS = auto()


# Factors of the confidence other than likely and found. A refusal names the first of equal ones.
_FACTORS = ('distinct', 'near', 'camera', 'genuine', 'not_mirrored', 'uncontradicted', 'linked')
# Kind and message of a refusal, by the weakest factor of its Evidence.
_ADVICE = {
    'near': (RefusalKind.UNCERTAIN_POSITION, 'position uncertain by {0.deviation_m:.2g} m; turn '
                                             'the camera to more or nearer objects'),
    'camera': (RefusalKind.WRONG_CAMERA,
               'camera_info or the pixels of the boxes may be wrong; turn the camera to nearer '
               'objects, or check camera_info'),
    'genuine': (RefusalKind.CHANGED, '{0.recognized.inliers} points of keyframes look like a '
                                     'picture or a changed place; move and request again'),
    'not_mirrored': (RefusalKind.AMBIGUOUS, 'the mirrored image fits another pose; turn the '
                                            'camera to more objects'),
    'linked': (RefusalKind.FRAMES_DISAGREE, 'the newest image does not fit the earlier '
                                            'ones; turn the camera to more objects'),
    'found': (RefusalKind.SEARCH_CUT_SHORT,
              'pose found only {0.meetings:g} times in {0.tried} samples; raise iterations or set '
              'algorithm to auto')}


class Refusal(NamedTuple):
    """The kind of a refusal, and the reason in one line."""

    kind: RefusalKind
    reason: str


@dataclass(frozen=True)
class Rival:
    """The most likely pose that disagrees with the leading pose."""

    likely: float  #: Probability of the pose
    place: Point  #: Position of the camera at this pose [m]
    map: str = ''  #: Name of its map if there are several
    #: Whether keyframes propose one of the two poses and objects the other
    is_other_source: bool = False
    is_tilted: bool = False  #: Whether the pose contradicts the known vertical
    tags: TagPlace | None = None  #: The place that tags name, if they propose the pose


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against the leading pose."""

    inliers: int  #: Number of objects that the pose explains
    #: Probability that the pose is right, given all poses found, see
    #: cliploc_ros.core.acceptance.confidence
    likely: float
    _: KW_ONLY
    #: Probability that the pose is right by keyframes alone; 0 if they do not propose it
    by_points: float = 0.0
    rival: Rival | None = None
    distinct: float = 1.0  #: Probability that the pose is not at a place that looks alike
    #: Position of the camera at this pose, and at the most likely place that looks alike [m]
    place: Point = (0.0, 0.0, 0.0)
    twin: Point | None = None
    twin_map: str = ''  #: Name of the twin's map if there are several
    near: float = 1.0  #: Probability, by the covariance, that a right pose is within 1 m
    #: Factor by which camera errors lower that probability, and a description of what is very
    #: likely wrong with a camera, or '', see cliploc_ros.core.acceptance.camera_check
    camera: float = 1.0
    camera_fault: str = ''
    deviation_m: float = 0.0  #: Standard deviation of the position [m]
    coverage: float = 1.0  #: Share of its samples that the search tried, 0 to 1
    tried: int = 0  #: Number of samples that the search tried
    #: Number of these samples that consist of inliers of the best pose of objects; infinite for a
    #: search that tried all samples
    meetings: float = math.inf
    unexplained: float = 0.0  #: Number of detected objects of the map's classes that do not match
    #: Signs that the place is real, not a picture; None if keyframes do not propose the pose
    signs: Signs | None = None
    motion: Motion | None = None  #: Motion since an earlier look by keyframes
    #: Probability that the image is not mirrored, see cliploc_ros.core.acceptance.comparison
    not_mirrored: float = 1.0
    #: Probability that keyframes are wrong if they recognize only other places
    uncontradicted: float = 1.0
    recognized: RecognizedPlace | None = None  #: The place that keyframes recognize at the pose
    tags: TagPlace | None = None  #: The place that tags name at the pose
    prior: float = 0.0  #: Log odds, at most 0, of the pose given the prior region
    #: Probability that odometry links all frames, see cliploc_ros.core.acceptance.links
    linked: float = 1.0
    tilt_deg: float = 0.0  #: Tilt of the robot at the pose [deg]; 0 without a base_frame
    #: The earlier looks and their confidence in this pose
    earlier: tuple[EarlierLook, ...] = ()
    crops_left: int = 0  #: Number of crops that have not been compared with labels yet

    @property
    def found(self) -> float:
        """Return the probability that the search of objects has not missed a better pose.

        A rival with as many inliers is sampled about as often as the best pose. Random draws miss
        it with probability exp(-meetings) (Fischler and Bolles 1981). This holds for ransac. For
        auto and PROSAC, whose order is not random, it is an assumption.
        """
        return 1.0 - CALIBRATION.search.missed_is_right * math.exp(-self.meetings)

    @property
    def genuine(self) -> float:
        """Return the probability that the place is real, not a picture, and unchanged."""
        if self.recognized and self.recognized.parted >= CALIBRATION.genuine.least_parted:
            return 0.5
        return 1.0 if self.signs is None else chance_genuine(self.signs, self.motion)

    @property
    def certainty(self) -> float:
        """Return the probability that the pose is not wrong for a reason other than its rivals."""
        return math.prod(getattr(self, name) for name in _FACTORS)

    @property
    def confidence(self) -> float:
        """Return the probability that the leading pose is within 1 m of the truth."""
        return max(self.likely * self.found, self.by_points) * self.certainty

    @property
    def confidence_of_view(self) -> float:
        """Return the confidence by the mean log odds of all looks of this view."""
        most = CALIBRATION.covariance.most_confidence
        looks = np.clip([self.confidence, *(max(0.5, look.doubted) for look in self.earlier)],
                        1.0 - most, most)
        mean = np.average(np.log(looks / (1.0 - looks)),
                          weights=[1.0, *(look.same_view for look in self.earlier)])
        return float(1.0 / (1.0 + np.exp(-mean)))

    @property
    def mean_confidence(self) -> float:
        """Return the mean confidence of all looks in this pose."""
        return float(np.mean([self.confidence, *(look.confidence for look in self.earlier)]))


def refusal(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return the refusal of the leading pose; None if it is accepted.

    A search of objects that was too short, or matched too few objects, does not matter if the
    confidence by keyframes alone is high enough.
    """
    by_points = evidence.by_points >= needed_confidence(evidence, options)
    if evidence.camera_fault and not by_points:
        return Refusal(RefusalKind.WRONG_CAMERA, f'{evidence.camera_fault}; check camera_info, '
                                                 'and the pixels and corners of the boxes')
    refused = None if by_points else _too_little(evidence, options)
    refused = refused or _too_unlikely(evidence, options)
    needed = min(CALIBRATION.looks.mean_confidence, options.min_confidence)
    if refused is None and evidence.confidence_of_view < options.min_confidence - 1e-9:
        return Refusal(RefusalKind.FRAMES_DISAGREE,
                       f'confidence {_rounded_down(evidence.confidence_of_view)} < '
                       f'{options.min_confidence:g} over the last {len(evidence.earlier) + 1} '
                       'frames of this view; move, or turn the camera')
    if refused or evidence.mean_confidence >= needed:
        return refused or too_tilted(evidence.tilt_deg, options)
    return Refusal(RefusalKind.FRAMES_DISAGREE,
                   f'mean confidence {_rounded_down(evidence.mean_confidence)} < {needed:g} in '
                   f'this pose over the last {len(evidence.earlier) + 1} frames; {_LOOK_ABOUT}')


def too_tilted(tilt_deg: float, options: RelocalizerOptions) -> Refusal | None:
    """Return the refusal of a pose at which the robot is tilted by an angle [deg]; else None."""
    most_deg = CALIBRATION.attitude.most_tilt_deg
    if tilt_deg <= most_deg or options.tilt_deviation_deg == 0.0:
        return None
    return Refusal(RefusalKind.WRONG_MOUNT,
                   f'the robot would be tilted by {tilt_deg:.0f} degrees > {most_deg:g}; correct '
                   'tf or the turned image; if true: tilt_deviation_deg 0')


def needed_confidence(evidence: Evidence, options: RelocalizerOptions) -> float:
    """Return the confidence that a pose needs. While crops are left, it is higher.

    Each search with more crops is another chance of a false accept, as in the interim analyses of
    clinical trials (Haybittle, "Repeated assessment of results in clinical trials of cancer
    treatment", 1971). This also holds for a search that ends because time is up.
    """
    if not evidence.crops_left:
        return options.min_confidence
    return 1.0 - CALIBRATION.search.early_share * (1.0 - options.min_confidence)


def _too_little(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return the refusal if the search was too short or matched too few objects; else None."""
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
    if evidence.inliers >= options.min_inliers or evidence.tags is not None:
        return None  # a tag names the place, and few objects may tell which of its poses is right
    return Refusal(RefusalKind.TOO_FEW_OBJECTS,
                   f'{evidence.inliers} objects matched < {options.min_inliers}'
                   f'{_points(evidence)}; {_LOOK_ABOUT}')


def _too_unlikely(evidence: Evidence, options: RelocalizerOptions) -> Refusal | None:
    """Return the refusal, with the main cause, if the confidence is too low; else None."""
    confidence, needed = evidence.confidence, needed_confidence(evidence, options)
    if confidence >= needed:
        return None
    if confidence >= options.min_confidence:
        digits = 1 + math.ceil(-math.log10(1.0 - needed))
        return Refusal(RefusalKind.NOT_ALL_CROPS,
                       f'confidence {_rounded_down(confidence, digits)} < {needed:.{digits}f}, '
                       f'required while {evidence.crops_left} crops are not compared; raise '
                       'timeout_s')
    compared = f'confidence {_rounded_down(confidence)} < {options.min_confidence:g}'
    if evidence.prior < 0.0:
        compared += '; the prior puts the robot elsewhere'
    likely, rival = max(evidence.likely, evidence.by_points), evidence.rival
    found = max(evidence.likely * evidence.found, evidence.by_points) / max(likely, 1e-9)
    weakest = min(('likely', likely), *((name, getattr(evidence, name)) for name in _FACTORS),
                  ('found', found), key=lambda factor: factor[1])[0]
    # a rival has most of the missing probability, or nearly the probability of the pose
    terms = CALIBRATION.refusals
    ambiguous = rival is not None and rival.likely > max(terms.least_rival, min(
        terms.of_leading * evidence.likely, terms.of_missing * (1.0 - evidence.likely)))
    # the twin may be among the rivals, too
    if evidence.twin is not None and evidence.distinct < options.min_confidence and (
            weakest == 'distinct' or (weakest == 'likely' and ambiguous)):
        kind, second = RefusalKind.LOOK_ALIKE, evidence.twin_map and (
            f' (the second in {evidence.twin_map})')
        cause = (f'{_point(evidence.place)} and {_point(evidence.twin)} m look alike{second}; '
                'turn the camera to objects that differ')
    elif weakest in ('likely', 'uncontradicted') and (of_tags := _of_tags(evidence, ambiguous)):
        kind, cause = of_tags
    elif weakest in _ADVICE and (weakest != 'genuine' or evidence.recognized is not None):
        kind, sentence = _ADVICE[weakest]
        cause = sentence.format(evidence)
    elif rival is None or not (weakest == 'uncontradicted' or ambiguous):
        kind = RefusalKind.UNEXPLAINED
        cause = (f'{evidence.inliers} objects matched, {round(evidence.unexplained)} unexplained'
                f'{_points(evidence)}; {_LOOK_ABOUT}')
    elif rival.is_other_source or weakest == 'uncontradicted':
        apart = float(np.linalg.norm(np.subtract(rival.place, evidence.place)))
        kind = RefusalKind.CONTRADICTION
        cause = f'objects and keyframes give poses {apart:.2f} m apart; {_LOOK_ABOUT}'
    elif rival.is_tilted and rival.likely > 0.5:
        kind, cause = RefusalKind.WRONG_MOUNT, (
            'the boxes fit a pose that contradicts the vertical; check tf, imu and the image')
    else:
        where = f' in {rival.map}' if rival.map else ''
        kind, cause = RefusalKind.AMBIGUOUS, (
            f'ambiguous: another pose{where} has probability {rival.likely:.2g}; turn the camera '
            'to objects that differ')
    return Refusal(kind, f'{compared}; {cause}')


def _of_tags(evidence: Evidence, ambiguous: bool) -> Refusal | None:
    """Return the refusal of a pose that tags name or contradict; None without such tags."""
    ours, rival = evidence.tags, evidence.rival
    theirs = rival.tags if rival is not None and ambiguous else None
    if ours is not None and theirs is not None and ours.names == theirs.names:
        return Refusal(RefusalKind.AMBIGUOUS, (
            f'{", ".join(ours.names)} fits two poses; move nearer, or {_LOOK_ABOUT}'))
    tags = ours or theirs
    return tags and Refusal(RefusalKind.CONTRADICTION, (
        f'{", ".join(tags.names)} and {", ".join(tags.others) or "objects or keyframes"} '
        'disagree: a tag that was moved or copied, has another size, or is on a screen or robot? '
        + _LOOK_ABOUT))


def _points(evidence: Evidence) -> str:
    """Describe the keyframes that match at the pose, as part of a sentence; empty without any."""
    if evidence.recognized is None:
        return ''
    is_tilted = evidence.recognized.tilt_error > CALIBRATION.attitude.vertical_sigmas
    return (f', {evidence.recognized.inliers} points of keyframes agree in '
            f'{evidence.recognized.confirmed:.0%} of the image'
            + ' and contradict the known vertical (check gravity, tf and imu)' * is_tilted)


def _point(position: Point) -> str:
    return f'({position[0]:.1f}, {position[1]:.1f}, {position[2]:.1f})'


def _rounded_down(share: float, digits: int = 2) -> str:
    """Format a share, rounded down: 0.9899 stays below 0.99."""
    return f'{math.floor(share * 10**digits + 1e-9) / 10**digits:.{digits}f}'
