# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice and verification of a pose as scoring has them, but no further than the pose may lead.

Upper bounds of IoUs, from extents and areas alone, stand in for the IoUs wherever these cannot
change what is found: a pose whose bounds sum to no more than the worst leader's score is left, and
of a detection's landmarks only those are compared exactly whose bound beats what it has. Results
are those of scoring, to rounding.
"""

from math import cos, inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.culling import Groups
from cliploc_ros.core.association.scene import Scene
from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.geometry.ellipse import ellipse_iou
from cliploc_ros.core.geometry.p3p import MAX_SOLUTIONS
from cliploc_ros.core.geometry.projection import project, project_groups

# A bound is raised by this, more than rounding can make an IoU or a sum of them greater.
_ROUNDING = 1e-9


class Prior(NamedTuple):
    """What is known of the camera before it looks; by default nothing.

    Parameters
    ----------
    up_in_camera, up_in_map : tuple of float
        The vertical, unit vectors in the camera's optical frame and in the map frame.
    min_height, max_height : float
        Of the camera's centre, along up_in_map from the map's origin [m].
    max_tilt : float
        Greatest angle between both verticals at a pose from three points [rad]. Poses from two
        points hold them equal.
    """

    up_in_camera: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up_in_map: tuple[float, float, float] = (0.0, 0.0, 1.0)
    min_height: float = -inf
    max_height: float = inf
    max_tilt: float = pi

    def as_array(self) -> NDArray[np.float64]:
        """Return up in the camera and in the map, least and greatest height, least cosine."""
        least_cosine = cos(self.max_tilt) if self.max_tilt < pi else -inf
        return np.array([*self.up_in_camera, *self.up_in_map, self.min_height, self.max_height,
                         least_cosine])


class Bench(NamedTuple):
    """A scene laid out for one search, and the memory its hypotheses use again and again.

    Parameters
    ----------
    candidates : ndarray (c, 16)
        Bearing (3,) and box ellipse (4,) of the detection, centre (3,) and shape (6,) of the
        landmark of each correspondence candidate.
    nearby : ndarray (L, 10)
        The map's landmarks, sorted, see SortedLandmarks.
    groups : Groups
    landmarks : ndarray (u, 10)
        Centres, shapes and squared radii of the landmarks that single detections may show. The
        radii are infinite: these are looked at from anywhere.
    boxes : ndarray (n, 4)
        Box ellipses of the detections.
    starts, detections : ndarray (u + 1,), (v,)
        Where each of these landmarks' detections begin in detections.
    prior : ndarray (9,)
        See Prior.as_array.
    iou_threshold : float
        See Scene.
    bearings, points : ndarray (3, 3)
        The minimal sample.
    rotations, translations : ndarray (4, 3, 3), (4, 3)
        The poses that it allows.
    sampled_boxes, sampled_landmarks : ndarray (3, 4), (3, 10)
        Rows of boxes and landmarks that are the minimal sample.
    sampled_outlines : ndarray (12, 6)
        Outlines of the sampled landmarks, three for each pose.
    uppers : ndarray (4,)
        Upper bounds of the sums of their IoUs; -1 where a pose is out of the question.
    seen : ndarray (2, w)
        Members of the groups that one pose may see.
    outlines : ndarray (w, 6)
        Of all that it may see: centre, half extents, exy, the semi-axes' product. Room for all,
        of which the system gives only what is written to; so too the next three.
    owners : ndarray (w,)
        The place in starts of each outline's detections.
    entries, bounds : ndarray (x, 2), (x,)
        Pairs of detection and outline that may overlap enough, and upper bounds of their IoUs.
    best_bounds : ndarray (n,)
        The greatest of each detection.
    """

    candidates: NDArray[np.float64]
    nearby: NDArray[np.float64]
    groups: Groups
    landmarks: NDArray[np.float64]
    boxes: NDArray[np.float64]
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]
    prior: NDArray[np.float64]
    iou_threshold: float
    bearings: NDArray[np.float64]
    points: NDArray[np.float64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    sampled_boxes: NDArray[np.float64]
    sampled_landmarks: NDArray[np.float64]
    sampled_outlines: NDArray[np.float64]
    uppers: NDArray[np.float64]
    seen: NDArray[np.int64]
    outlines: NDArray[np.float64]
    owners: NDArray[np.int64]
    entries: NDArray[np.int64]
    bounds: NDArray[np.float64]
    best_bounds: NDArray[np.float64]


def set_up(scene: Scene, prior: Prior | None = None) -> Bench:
    """Return the bench of a scene.

    Parameters
    ----------
    scene : Scene
    prior : Prior, optional
        Poses that it rules out are not verified.
    """
    detections, landmarks = scene.pairs[:, 0], scene.pairs[:, 1]
    rows, groups = scene.potential_landmarks, scene.groups
    table = np.column_stack([scene.centers[rows], scene.shapes[rows], np.full(len(rows), inf)])
    group_sizes = np.bincount(groups.members[:, 1], minlength=len(groups.reaches))
    pairs = len(scene.potential_detections) + int(group_sizes @ np.diff(groups.starts))
    count = len(rows) + len(groups.members)
    owners = np.empty(count, dtype=np.int64)
    owners[:len(rows)] = np.arange(len(rows))
    return Bench(
        np.concatenate([scene.bearings[detections], scene.box_ellipses[detections],
                        scene.centers[landmarks], scene.shapes[landmarks]], axis=1),
        scene.nearby.landmarks, groups, table, scene.box_ellipses, scene.potential_starts,
        scene.potential_detections, (prior or Prior()).as_array(),
        scene.iou_threshold, np.empty((3, 3)), np.empty((3, 3)),
        np.empty((MAX_SOLUTIONS, 3, 3)), np.empty((MAX_SOLUTIONS, 3)),
        np.empty((3, 4)), np.full((3, 10), inf),
        np.empty((3 * MAX_SOLUTIONS, 6)), np.empty(MAX_SOLUTIONS),
        np.empty((2, len(groups.members)), dtype=np.int64), np.empty((count, 6)),
        owners, np.empty((pairs, 2), dtype=np.int64), np.empty(pairs),
        np.empty(len(scene.bearings)))


@compiled
def load_sample(candidates, samples, number, size, bearings, points, sampled_boxes,
                sampled_landmarks):
    """Copy one of some minimal samples to where the solver and the choice of a pose take it."""
    for row in range(size):
        candidate = samples[number, row]
        for axis in range(3):
            bearings[row, axis] = candidates[candidate, axis]
            points[row, axis] = candidates[candidate, 7 + axis]
        for column in range(4):
            sampled_boxes[row, column] = candidates[candidate, 3 + column]
        for column in range(9):
            sampled_landmarks[row, column] = candidates[candidate, 7 + column]


@compiled
def allowed(prior, rotations, translations, which):
    """Tell whether a pose agrees with what is known of vertical and height."""
    r, height, cosine = rotations, 0.0, 0.0
    for axis in range(3):
        up = (r[which, axis, 0] * prior[3] + r[which, axis, 1] * prior[4]
              + r[which, axis, 2] * prior[5])
        cosine += up * prior[axis]
        height -= up * translations[which, axis]
    return prior[6] <= height <= prior[7] and cosine >= prior[8]


@compiled
def iou_bound(u, v, half_width, half_height, cx, cy, half_x, half_y, axes):
    """Return an upper bound of the IoU of a box's ellipse and another.

    Parameters
    ----------
    u, v, half_width, half_height : float
        Centre and semi-axes of the box's ellipse.
    cx, cy, half_x, half_y, axes : float
        Centre and half extents of the other, and the product of its semi-axes.
    """
    width = min(u + half_width, cx + half_x) - max(u - half_width, cx - half_x)
    height = min(v + half_height, cy + half_y) - max(v - half_height, cy - half_y)
    if not (width > 0.0 and height > 0.0):
        return 0.0
    # in units of pi: the shared area lies in both ellipses, and in what their boxes share
    box_axes = half_width * half_height
    shared = min(width * height * (1.0 / pi), min(axes, box_axes))
    return shared / (axes + box_axes - shared) + _ROUNDING


@compiled
def choose_pose(prior, rotations, translations, size, count, boxes, landmarks, outlines, uppers,
                least_iou):
    """Return which of some poses to verify; -1 for none.

    It is sample_pose's: the one with the greatest sum of IoUs over the sampled pairs, of those
    in front of which all sampled ellipsoids lie and which the prior allows; none if the sum is
    below least_iou.
    """
    visible, last = 0, -1
    for which in range(count):
        uppers[which] = -1.0
        if allowed(prior, rotations, translations, which):
            project(rotations, translations, which, landmarks, 0, size, 1.0,
                    outlines, 3 * which)
            uppers[which] = _sampled_upper(boxes, size, outlines, 3 * which)
        if uppers[which] >= least_iou:
            visible += 1
            last = which
    if visible == 0 or (visible == 1 and least_iou <= 0.0):
        return last
    best, best_total = -1, -1.0
    for _ in range(visible):
        which = 0  # whose bound is the greatest, the first of equals
        for other in range(1, count):
            if uppers[other] > uppers[which]:
                which = other
        if uppers[which] < max(best_total, least_iou):
            break
        total = _sampled_total(boxes, size, outlines, 3 * which)
        uppers[which] = -1.0
        if total > best_total or (total == best_total and which < best):
            best, best_total = which, total
    return best if best_total >= least_iou else -1


@compiled
def _sampled_upper(boxes, size, outlines, first):
    """Return an upper bound of the sum of IoUs of the sampled pairs; -1 if one is not in front."""
    upper = 0.0
    for row in range(size):
        out = first + row
        if not outlines[out, 2] > 0.0:
            return -1.0
        upper += iou_bound(boxes[row, 0], boxes[row, 1], boxes[row, 2], boxes[row, 3],
                           outlines[out, 0], outlines[out, 1], outlines[out, 2],
                           outlines[out, 3], outlines[out, 5])
    return upper


@compiled
def _sampled_total(boxes, size, outlines, first):
    """Return the sum of IoUs of the sampled pairs."""
    total = 0.0
    for row in range(size):
        out = first + row
        total += ellipse_iou(boxes[row, 0], boxes[row, 1], boxes[row, 2], boxes[row, 3],
                             outlines[out, 0], outlines[out, 1],
                             outlines[out, 2] * outlines[out, 2], outlines[out, 4],
                             outlines[out, 3] * outlines[out, 3])
    return total


@compiled
def verify_beyond(nearby, groups, landmarks, boxes, starts, detections, iou_threshold, rotations,
                  translations, which, seen, outlines, owners, entries, bounds, best_bounds,
                  floor):
    """Return the score of a pose if it is above a floor; if not, the floor."""
    best_bounds[:] = iou_threshold
    count = landmarks.shape[0]
    project(rotations, translations, which, landmarks, 0, count, 1.0, outlines, 0)
    count = _bound(boxes, starts, owners, detections, iou_threshold, 0, count, outlines, entries,
                   bounds, best_bounds, 0)
    if groups.reaches.shape[0] > 0:
        first = landmarks.shape[0]
        last = project_groups(nearby, groups, rotations, translations, which, seen, outlines,
                              owners, first)
        count = _bound(boxes, groups.starts, owners, groups.detections, iou_threshold, first,
                       last, outlines, entries, bounds, best_bounds, count)
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
        for entry in range(count):
            if entries[entry, 0] == detection and bounds[entry] > best:
                row = entries[entry, 1]
                best = max(best, ellipse_iou(
                    boxes[detection, 0], boxes[detection, 1], boxes[detection, 2],
                    boxes[detection, 3], outlines[row, 0], outlines[row, 1],
                    outlines[row, 2] * outlines[row, 2], outlines[row, 4],
                    outlines[row, 3] * outlines[row, 3]))
        if best <= iou_threshold:
            best = 0.0
        score += best
        upper += best - best_bounds[detection]
        if upper <= floor:
            return floor
    return score


@compiled
def _bound(boxes, starts, owners, detections, iou_threshold, first, last, outlines, entries,
           bounds, best_bounds, count):
    """Add the pairs of some outlines that may overlap enough; return how many there are now."""
    for outline in range(first, last):
        place = owners[outline]
        half_x = outlines[outline, 2]
        if not half_x > 0.0:
            continue
        cx, cy, half_y = outlines[outline, 0], outlines[outline, 1], outlines[outline, 3]
        axes = outlines[outline, 5]
        for pair in range(starts[place], starts[place + 1]):
            detection = detections[pair]
            bound = iou_bound(boxes[detection, 0], boxes[detection, 1], boxes[detection, 2],
                              boxes[detection, 3], cx, cy, half_x, half_y, axes)
            if bound > iou_threshold:
                entries[count, 0], entries[count, 1] = detection, outline
                bounds[count] = bound
                best_bounds[detection] = max(best_bounds[detection], bound)
                count += 1
    return count
