# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search kernel: hypotheses from minimal samples, verified only while they can become leaders.

The hypothesis of a sample is the solution of the minimal solver at which the sampled landmarks
overlap their boxes most (Matsuzaki et al. 2024, Sec. III-D2). Verification assigns each detection
the potential landmark that overlaps it most, see cliploc_ros.core.fit.verification.

Upper bounds of IoUs, computed from extents and areas alone, replace IoUs that cannot change the
result. A pose is dropped as soon as the sum of its bounds does not exceed the worst leader's
score. A detection is compared exactly only with landmarks whose bound exceeds its best IoU. The
results equal those of full verification up to rounding.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipse import ellipse_iou, iou_bound
from cliploc_ros.core.geometry.ellipsoid import Poses, project
from cliploc_ros.core.geometry.minimal_solvers import MAX_SOLUTIONS, p3p, two_point
from cliploc_ros.core.kernels.compiled import ZERO, compiled
from cliploc_ros.core.map.culling import Groups, project_visible
from cliploc_ros.core.search.scene import Constraint, Scene


class Targets(NamedTuple):
    """Detections and landmarks that verify poses."""

    boxes: NDArray[np.float64]  #: (n, 4): box ellipses of the detections
    iou_threshold: float  #: See Scene
    #: (u, 9): centres and shapes of the landmarks that single detections may show
    landmarks: NDArray[np.float64]
    #: (u + 1,), (p,): detections of each of these landmarks, see
    #: cliploc_ros.core.search.scene.Potential
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]
    #: (L, 9): centres and shapes of the map's landmarks, see SortedLandmarks
    sorted_landmarks: NDArray[np.float64]
    groups: Groups  #: The landmarks that detections may show because of their class


class Sample(NamedTuple):
    """Buffers for one minimal sample of three candidates, or two."""

    bearings: NDArray[np.float64]  #: (3, 3): through the box centres
    boxes: NDArray[np.float64]  #: (3, 4): box ellipses
    landmarks: NDArray[np.float64]  #: (3, 9): centres and shapes
    #: (12, 6): outlines of the landmarks at each of up to four poses, see project
    outlines: NDArray[np.float64]
    #: (4,): upper bound of the summed IoUs at each pose; -1 if the pose is impossible
    uppers: NDArray[np.float64]


class Overlaps(NamedTuple):
    """Buffers for one verification.

    They have room for every landmark and every pair. The operating system allocates only the
    pages that are written.
    """

    #: (2, w): members of the groups that may be visible, see visible_members
    visible: NDArray[np.int64]
    #: (o, 6): outlines of all landmarks that may be visible, see project
    outlines: NDArray[np.float64]
    owners: NDArray[np.int64]  #: (o,): row of each outline in `starts`, which gives its detections
    #: (x, 2), (x,): pairs of detection and outline that may overlap enough, and upper bounds of
    #: their IoUs
    pairs: NDArray[np.int64]
    bounds: NDArray[np.float64]
    best_bounds: NDArray[np.float64]  #: (n,): the greatest bound of each detection


class Bench(NamedTuple):
    """A scene as tables for one search, and the buffers that all hypotheses share."""

    #: (c, 16): for each correspondence candidate, bearing (3,) and box ellipse (4,) of the
    #: detection, centre (3,) and shape (6,) of the landmark
    candidates: NDArray[np.float64]
    constraint: NDArray[np.float64]  #: (9,): see Constraint.as_array
    targets: Targets
    sample: Sample
    poses: Poses  #: Solutions of the minimal solver for the sample
    overlaps: Overlaps


def set_up(scene: Scene, constraint: Constraint | None = None) -> Bench:
    """Prepare a scene for a search."""
    detections, landmarks = scene.pairs[:, 0], scene.pairs[:, 1]
    candidates = np.concatenate([scene.bearings[detections], scene.box_ellipses[detections],
                                 scene.centers[landmarks], scene.shapes[landmarks]], axis=1)
    potential = scene.potential
    table = np.column_stack([scene.centers[potential.landmarks],
                             scene.shapes[potential.landmarks]])
    targets = Targets(scene.box_ellipses, scene.iou_threshold, table, potential.starts,
                      potential.detections, scene.sorted_landmarks.landmarks, scene.groups)
    sample = Sample(np.empty((3, 3)), np.empty((3, 4)), np.empty((3, 9)),
                    np.empty((3 * MAX_SOLUTIONS, 6)), np.empty(MAX_SOLUTIONS))
    single, members, shown = len(table), scene.groups.members, np.diff(scene.groups.starts)
    pairs = len(potential.detections) + int(
        np.bincount(members[:, 1], minlength=len(shown)) @ shown)
    owners = np.empty(single + len(members), dtype=np.int64)
    owners[:single] = np.arange(single)
    overlaps = Overlaps(np.empty((2, len(members)), dtype=np.int64), np.empty((len(owners), 6)),
                        owners, np.empty((pairs, 2), dtype=np.int64), np.empty(pairs),
                        np.empty(len(scene.box_ellipses)))
    return Bench(candidates, (constraint or Constraint()).as_array(), targets, sample,
                 Poses(np.empty((MAX_SOLUTIONS, 3, 3)), np.empty((MAX_SOLUTIONS, 3))), overlaps)


@compiled
def make_hypothesis(candidates, constraint, sample, poses, samples, number, least_iou):
    """Solve samples[number] for poses; return the index of the pose to verify, or -1.

    Parameters
    ----------
    candidates, constraint, sample, poses
        Fields of the Bench. Passing the whole Bench is slow: each call would update the reference
        counts of all its arrays.
    samples : ndarray (t, 3) of int
        Three candidates, or two and -1.
    least_iou : float
        A pose whose sampled pairs have a smaller sum of IoUs is not verified.
    """
    size = 3 if samples[number, 2] >= 0 else 2
    _load(candidates, samples, number, size, sample)
    if size == 3:
        count = p3p(sample.bearings, sample.landmarks, poses.rotations, poses.translations)
    else:
        count = two_point(sample.bearings, sample.landmarks, constraint, poses.rotations,
                          poses.translations)
    return _choose_pose(constraint, sample, size, poses, count, least_iou)


@compiled
def _load(candidates, samples, number, size, sample):
    """Copy the candidates of a sample from the table to its buffers."""
    for row in range(size):
        candidate = samples[number, row]
        for column in range(3):
            sample.bearings[row, column] = candidates[candidate, column]
        for column in range(4):
            sample.boxes[row, column] = candidates[candidate, 3 + column]
        for column in range(9):
            sample.landmarks[row, column] = candidates[candidate, 7 + column]


@compiled
def _choose_pose(constraint, sample, size, poses, count, least_iou):
    """Return the index of the pose with the greatest sum of IoUs of the sampled pairs, or -1.

    All sampled ellipsoids must be entirely in front of the camera, the pose must agree with the
    constraint, and the sum of IoUs must be at least least_iou.
    """
    boxes, outlines, uppers = sample.boxes, sample.outlines, sample.uppers
    visible, last = 0, -1
    for which in range(count):
        uppers[which] = -1.0
        if _agrees(constraint, poses, which):
            project(sample.landmarks, ZERO, size, poses, which, outlines, 3 * which)
            upper = 0.0  # of the sum of IoUs
            for row in range(size):
                if not outlines[3 * which + row, 2] > 0.0:
                    upper = -1.0
                    break
                upper += _outline_bound(boxes, row, outlines, 3 * which + row)
            uppers[which] = upper
        if uppers[which] >= least_iou:
            visible += 1
            last = which
    if visible == 0 or (visible == 1 and least_iou <= 0.0):
        return last
    best, best_total = -1, -1.0
    for _ in range(visible):
        which = 0  # the greatest bound; of equal bounds, the first
        for other in range(1, count):
            if uppers[other] > uppers[which]:
                which = other
        if uppers[which] < max(best_total, least_iou):
            break
        total = 0.0
        for row in range(size):
            total += _outline_iou(boxes, row, outlines, 3 * which + row)
        uppers[which] = -1.0
        if total > best_total or (total == best_total and which < best):
            best, best_total = which, total
    return best if best_total >= least_iou else -1


@compiled
def _agrees(constraint, poses, which):
    """Check whether a pose agrees with the known vertical and range of heights."""
    rotations, translations, height, cosine = poses.rotations, poses.translations, 0.0, 0.0
    for axis in range(3):
        up = (rotations[which, axis, 0] * constraint[3] + rotations[which, axis, 1] * constraint[4]
              + rotations[which, axis, 2] * constraint[5])
        cosine += up * constraint[axis]
        height -= up * translations[which, axis]
    return constraint[6] <= height <= constraint[7] and cosine >= constraint[8]


@compiled
def _outline_bound(boxes, box, outlines, out):
    """Return an upper bound of the IoU of boxes[box] and outlines[out]."""
    return iou_bound(boxes[box, 0], boxes[box, 1], boxes[box, 2], boxes[box, 3],
                     outlines[out, 0], outlines[out, 1], outlines[out, 2], outlines[out, 3],
                     outlines[out, 5])


@compiled
def _outline_iou(boxes, box, outlines, out):
    """Return the IoU of boxes[box] and outlines[out]."""
    return ellipse_iou(boxes[box, 0], boxes[box, 1], boxes[box, 2], boxes[box, 3],
                       outlines[out, 0], outlines[out, 1], outlines[out, 2] * outlines[out, 2],
                       outlines[out, 4], outlines[out, 3] * outlines[out, 3])


@compiled
def verify_beyond(targets, poses, which, overlaps, floor):
    """Return the score of a pose, or the floor if the score does not exceed it."""
    groups, outlines = targets.groups, overlaps.outlines
    overlaps.best_bounds[:] = targets.iou_threshold
    single = targets.landmarks.shape[0]
    project(targets.landmarks, ZERO, single, poses, which, outlines, ZERO)
    count = _bound(targets, targets.starts, targets.detections, ZERO, single, overlaps, ZERO)
    if groups.members.shape[0] > 0:
        last = project_visible(targets.sorted_landmarks, groups, poses, which, overlaps.visible,
                               outlines, overlaps.owners, single)
        count = _bound(targets, groups.starts, groups.detections, single, last, overlaps, count)
    return _score_beyond(targets.boxes, targets.iou_threshold, overlaps, count, floor)


@compiled
def _bound(targets, starts, detections, first, last, overlaps, count):
    """Append the pairs of the outlines [first, last) after `count` pairs; return the new count."""
    boxes, iou_threshold = targets.boxes, targets.iou_threshold
    outlines, owners = overlaps.outlines, overlaps.owners
    pairs, bounds, best_bounds = overlaps.pairs, overlaps.bounds, overlaps.best_bounds
    for outline in range(first, last):
        if not outlines[outline, 2] > 0.0:
            continue
        owner = owners[outline]
        for place in range(starts[owner], starts[owner + 1]):
            detection = detections[place]
            bound = _outline_bound(boxes, detection, outlines, outline)
            if bound > iou_threshold:
                pairs[count, 0], pairs[count, 1] = detection, outline
                bounds[count] = bound
                best_bounds[detection] = max(best_bounds[detection], bound)
                count += 1
    return count


@compiled
def _score_beyond(boxes, iou_threshold, overlaps, count, floor):
    """Return the score of the bounded pairs, or the floor if the score does not exceed it."""
    outlines, pairs, bounds = overlaps.outlines, overlaps.pairs, overlaps.bounds
    best_bounds = overlaps.best_bounds
    upper = 0.0
    for detection in range(boxes.shape[0]):
        if best_bounds[detection] > iou_threshold:
            upper += best_bounds[detection]
    if upper <= floor:
        return floor
    score = 0.0
    for detection in range(boxes.shape[0]):
        if best_bounds[detection] <= iou_threshold:
            continue
        best = iou_threshold
        for pair in range(count):
            if pairs[pair, 0] == detection and bounds[pair] > best:
                best = max(best, _outline_iou(boxes, detection, outlines, pairs[pair, 1]))
        if best <= iou_threshold:
            best = 0.0
        score += best
        upper += best - best_bounds[detection]
        if upper <= floor:
            return floor
    return score
