# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether to believe the best pose. A wrong pose is worse than none."""

from dataclasses import dataclass

from cliploc_ros.core.options import RelocalizerOptions


@dataclass(frozen=True)
class Evidence:
    """What speaks for the best hypothesis, and what against it.

    Parameters
    ----------
    ious : tuple of float
        IoU of each inlier.
    landmarks : tuple of int
        The landmark that each inlier shows.
    rival_score : float
        Score of the best hypothesis elsewhere; 0 when there is none.
    """

    ious: tuple[float, ...]
    landmarks: tuple[int, ...]
    rival_score: float


def one_to_one(evidence: Evidence) -> tuple[int, float]:
    """Return the number of landmarks seen and the sum of each one's best IoU.

    Several boxes on one landmark say no more than the best of them.
    """
    best: dict[int, float] = {}
    for landmark, iou in zip(evidence.landmarks, evidence.ious, strict=True):
        best[landmark] = max(iou, best.get(landmark, 0.0))
    return len(best), sum(best.values())


def strength(evidence: Evidence) -> float:
    """Return the one-to-one score plus twice its margin over the best hypothesis elsewhere."""
    _, score = one_to_one(evidence)
    return score + 2.0 * (sum(evidence.ious) - evidence.rival_score)


def refusal(evidence: Evidence, options: RelocalizerOptions) -> str:
    """Return why the best hypothesis is not to be believed; empty if it is."""
    inliers, _ = one_to_one(evidence)
    if inliers < options.min_inliers:
        return (f'only {inliers} landmarks explain detections, {options.min_inliers} are needed: '
                'turn to where more objects are in view')
    found = strength(evidence)
    if found < options.min_evidence:
        return (f'ambiguous: evidence {found:.2f} is below {options.min_evidence:.2f} '
                f'(score {sum(evidence.ious):.2f}, best elsewhere {evidence.rival_score:.2f})')
    return ''
