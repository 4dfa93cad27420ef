# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether to believe the best pose. A wrong pose is worse than none."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.options import RelocalizerOptions

# Boxes that overlap more than this show one object, detected twice.
_SAME_BOX_IOU = 0.8
# Fewer samples have not looked for rivals: the margin over them would mean nothing.
_MIN_ITERATIONS = 500
# A rival as good as a pose that was met so often is missed with a chance of .05.
_MIN_MEETINGS = 3


@dataclass(frozen=True)
class Match:
    """A detection explained by a landmark: row of the detection, row in the map, IoU."""

    detection: int
    landmark: int
    iou: float


@dataclass(frozen=True)
class Support:
    """How many objects speak for a pose, and the sum of their IoUs."""

    inliers: int
    score: float


@dataclass(frozen=True)
class Evidence:
    """What speaks for the best hypothesis, and what against it.

    Parameters
    ----------
    inliers : int
        Objects that the best explains.
    score : float
        Sum of their IoUs.
    rival_score : float
        The same of the best hypothesis elsewhere; 0 when there is none.
    coverage : float
        The share of its samples that the search tried, 0 to 1.
    tried : int
        How many these are.
    meetings : int
        How many samples, of those that the search tried, hold nothing but inliers of the best
        hypothesis. A rival with as many inliers is met about as often, and missed with a chance
        of about exp(-meetings) (Fischler and Bolles 1981).
    """

    inliers: int
    score: float
    rival_score: float
    coverage: float = 1.0
    tried: int = 0
    meetings: int = 1_000_000

    @property
    def strength(self) -> float:
        """Return the score plus twice its margin over the best hypothesis elsewhere."""
        return self.score + 2.0 * (self.score - self.rival_score)


def support(matches: Sequence[Sequence[Match]], bboxes_xyxy: Sequence[NDArray[np.float64]]
            ) -> Support:
    """Return what speaks for a pose, each object once.

    Several boxes on one landmark, and several landmarks behind one box, say no more than the
    best of them. Frames that show one object share the errors of its shape in the map, so that
    their agreement is no more evidence than one of them: it counts with its mean IoU.

    Parameters
    ----------
    matches : sequence of sequence of Match
        Of each frame.
    bboxes_xyxy : sequence of ndarray (n, 4)
        The boxes that the matches count, of each frame [px].
    """
    ious: dict[int, list[float]] = {}
    for matches_here, boxes_here in zip(matches, bboxes_xyxy, strict=True):
        for match in _one_to_one(matches_here, boxes_here):
            ious.setdefault(match.landmark, []).append(match.iou)
    return Support(len(ious), sum(sum(some) / len(some) for some in ious.values()))


def _one_to_one(matches: Sequence[Match], bboxes_xyxy: NDArray[np.float64]) -> list[Match]:
    """Return the best matches of one frame, each landmark and each object once."""
    taken: list[Match] = []
    for match in sorted(matches, key=lambda match: -match.iou):
        boxes = bboxes_xyxy[[other.detection for other in taken]]
        if match.landmark in [other.landmark for other in taken]:
            continue
        if (_box_iou(bboxes_xyxy[match.detection], boxes) > _SAME_BOX_IOU).any():
            continue
        taken.append(match)
    return taken


def _box_iou(box: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU of a box (4,) with others (m, 4)."""
    others = others.reshape(-1, 4)
    overlap = np.prod(np.maximum(0.0, np.minimum(box[2:], others[:, 2:])
                                 - np.maximum(box[:2], others[:, :2])), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    return overlap / (np.prod(box[2:] - box[:2]) + areas - overlap)


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
    if evidence.meetings < _MIN_MEETINGS and not (
            options.algorithm in ('auto', 'bf') and evidence.coverage == 1.0):
        return (f'the search met this pose only {evidence.meetings} times in {evidence.tried} '
                'samples, so one as good may have been missed: raise iterations, or set '
                'algorithm to auto')
    if evidence.inliers < options.min_inliers:
        return (f'only {evidence.inliers} objects are where the map has them, '
                f'{options.min_inliers} are needed: turn to where more are in view')
    if evidence.strength < options.min_evidence:
        return (f'ambiguous: evidence {evidence.strength:.2f} is below '
                f'{options.min_evidence:.2f} (score {evidence.score:.2f}, best elsewhere '
                f'{evidence.rival_score:.2f})')
    if evidence.rival_score > options.max_rival * evidence.score:
        return (f'ambiguous: a pose elsewhere explains the image nearly as well (score '
                f'{evidence.score:.2f}, best elsewhere {evidence.rival_score:.2f}): turn to where '
                'more can be told apart')
    return ''
