# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find landmarks among the boxes of one class: sequential RANSAC over pairs of boxes.

A pair of boxes with enough parallax gives a hypothesis: a sphere where the rays of their centres
meet, fitted to the eight edges. Its support is the set of frames with a box that it overlaps well.
The hypothesis with the greatest support is fitted to it, its boxes are removed, and the search
continues. Every box is the seed of some hypotheses, so that rarely detected objects are found,
too.
"""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.mapping.evidence import gather_evidence
from cliploc_ros.offline.mapping.fitting import descend, fit_ellipsoid
from cliploc_ros.offline.mapping.landmarks import Landmarks, box_iou, group_boxes, project_box
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import NO_SIZE, Views
from cliploc_ros.offline.vocabulary.vocabulary import size_of_class

# Distance of the centre behind the visible surface, as a share of the radius that the box
# suggests, and its standard deviation. Chosen: the share is 1 for a ball, 0 for a picture on a
# wall.
_CENTER_SHARE, _CENTER_SIGMA = 0.6, 0.5
# Relative error of the measured depth.
_DEPTH_SIGMA = 0.05
# Landmarks with at least this parallax are located without depth, and give its scale.
_LEAST_BASELINE_DEG = 20.0
_LEAST_LANDMARKS = 3
# A scale this far from 1 is a wrong unit, not an error of calibration.
_UNIT_FACTOR = 1.6
# Smaller errors of scale are within the error of this estimate.
_LEAST_CORRECTION = 0.02

#: Greatest deviation of a landmark with depth [m]; it lies along the rays, where boxes hardly
# constrain it. Chosen on the kitchen's frames, where half this limit leaves out a sixth of the
# explained boxes.
MAX_SIGMA_WITH_DEPTH_M = 0.15
# Range of the angle between the rays of a pair: below it, the depth is uncertain; above it, the
# boxes show different sides of the object.
_PARALLAX_DEG = (5.0, 75.0)
_GREATEST_COSINE, _LEAST_COSINE = (float(value) for value in np.cos(np.radians(_PARALLAX_DEG)))
_MAX_GAP_S = 30.0
# The rays of a pair pass each other within this share of the object's radius, and the radii that
# both boxes suggest differ by at most this factor.
_MAX_MISS = 0.6
_MAX_RADIUS_RATIO = 1.6
_MIN_DEPTH_M = 0.1
# Number of hypotheses with each box as seed, and of steps in which each is fitted.
_PAIRS_PER_BOX, _PAIR_STEPS = 3, 6
#: A frame supports a landmark if one of its boxes overlaps it by more than this IoU.
SUPPORT_IOU = 0.45


def add_depths(views: Views, detections: PosedDetections,
               scales: NDArray[np.float64] | None = None) -> Views:
    """Add the depth of the object's centre for each box, and the sizes of classes, to views.

    With depth, boxes from one side locate a landmark, but do not constrain its length along the
    rays. The scales are true depth divided by measured depth, for each camera; None: all are 1.
    """
    assert detections.depths is not None
    scale = 1.0 if scales is None else scales[views.cameras[views.frames]]
    surfaces = scale * detections.depths.astype(np.float64)
    spreads = (np.zeros_like(surfaces) if detections.depth_spreads is None
               else scale * detections.depth_spreads)
    radii = box_radii(views, np.arange(len(surfaces)))
    # the centre lies deeper than the surface by a share of the box's half extent at its depth
    centers = surfaces / np.maximum(0.2, 1.0 - _CENTER_SHARE * radii)
    sigmas = np.sqrt(np.square(_DEPTH_SIGMA * centers) + np.square(spreads)
                     + np.square(_CENTER_SIGMA * radii * centers))
    known = np.isfinite(centers) & np.isfinite(sigmas)
    # the factor that covers almost all objects counts as two standard deviations
    sizes = np.array([NO_SIZE if size is None else
                      (np.log(0.5 * size.extent_m), 2.0 / np.log(size.factor))
                      for size in map(size_of_class, detections.class_names)])
    return views._replace(depths=np.where(known, centers, 0.0), depth_stiffness=np.where(
        known, 1.0 / np.where(known, sigmas, 1.0), 0.0),
        sizes=sizes[detections.classes])


def box_radii(views: Views, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the half extents (m,) of boxes on the plane z = 1: geometric means over both axes."""
    extents = views.edges[rows, 2:] - views.edges[rows, :2]
    return np.asarray(0.5 * np.sqrt(np.prod(np.maximum(extents, 0.0), axis=1)))


def _middles(views: Views, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the middles (m, 3) of boxes on the plane z = 1."""
    middles = 0.5 * (views.edges[rows, :2] + views.edges[rows, 2:])
    return np.concatenate([middles, np.ones((len(rows), 1))], axis=1)


def depth_hypotheses(views: Views, rows: NDArray[np.int64]
                     ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres (h, 3) and bases (h, 3, 3) of spheres at the measured depths of boxes."""
    rows = rows[views.depth_stiffness[rows] > 0.0]
    depths, frames = views.depths[rows], views.frames[rows]
    in_camera = _middles(views, rows) * depths[:, None]
    centers = np.einsum('fji,fj->fi', views.rotations[frames],
                        in_camera - views.translations[frames])
    return centers, (np.maximum(box_radii(views, rows), 1e-3) * depths)[:, None, None] * np.eye(3)


def scaled_depths(views: Views, detections: PosedDetections, landmarks: Landmarks,
                  shown: NDArray[np.int64]) -> tuple[Views, list[str]]:
    """Return the views with depth, corrected by a scale for each camera, and notes.

    The landmarks are fitted to boxes only. Those with enough parallax determine the scale.
    DatasetError: a scale is so far off that the unit of depth must be wrong.
    """
    baselines_deg = gather_evidence(views, landmarks, shown).baseline_deg
    measured = add_depths(views, detections)
    kept, notes = np.ones(len(detections.cameras)), list[str]()
    for number, name in enumerate(detections.camera_names):
        scale = _depth_scale(measured, landmarks, np.where(
            views.cameras[views.frames] == number, shown, -1), baselines_deg)
        if scale is None or abs(scale - 1.0) < _LEAST_CORRECTION:
            continue
        of = f' of {name}' if len(kept) > 1 else ''
        check_scale(scale, of, 'boxes')
        kept[number] = scale
        notes.append(f'measured depth{of} is {1.0 / scale:.3f} times the depth by boxes and '
                     'poses; it is corrected by this factor')
    return (add_depths(views, detections, kept) if notes else measured), notes


def check_scale(scale: float, of: str, by: str) -> None:
    """Refuse depth whose true value is `scale` times the measured one, by a measurement `by`.

    DatasetError: the scale is so far off that the unit of depth must be wrong.
    """
    if not 1.0 / _UNIT_FACTOR < scale < _UNIT_FACTOR:
        raise DatasetError(
            f'measured depth{of} is {1.0 / scale:.3g} times the depth by {by} and poses: wrong '
            f'unit? multiply `depth_unit` by {scale:.3g}, or give poses in metres')


def _depth_scale(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                 baselines_deg: NDArray[np.float64]) -> float | None:
    """Return true depth divided by measured depth; None if too few landmarks determine it.

    The array shown (n,) is -1 for boxes of other cameras.
    """
    ratios = []
    for number, rows in enumerate(group_boxes(shown, len(landmarks.centers))):
        rows = rows[views.depth_stiffness[rows] > 0.0]
        if len(rows) == 0 or baselines_deg[number] < _LEAST_BASELINE_DEG:
            continue
        frames = views.frames[rows]
        depths = (views.rotations[frames, 2] @ landmarks.centers[number]
                  + views.translations[frames, 2])
        ratios.append(float(np.median(depths / views.depths[rows])))
    return float(np.median(ratios)) if len(ratios) >= _LEAST_LANDMARKS else None


def triangulate(views: Views, rows: NDArray[np.int64], min_viewpoints: int,
                rng: np.random.Generator) -> Landmarks:
    """Find landmarks that explain boxes of one class, given in the order of time.

    Each landmark is the hypothesis that covers the most free boxes. A box belongs to at most one
    landmark.
    """
    if len(rows) < min_viewpoints:
        return Landmarks.none()
    seeds = np.repeat(rows, _PAIRS_PER_BOX)
    # origins, unit rays in the map, and radii at distance 1
    points = _middles(views, rows)
    lengths = np.linalg.norm(points, axis=1)
    rays = np.einsum('fji,fj->fi', views.rotations[views.frames[rows]], points / lengths[:, None])
    of_pairs = _pair_hypotheses(views, rows, seeds, rng.random(len(seeds)),
                                views.centers[views.frames[rows]], rays,
                                box_radii(views, rows) / lengths)
    centers, bases = map(np.concatenate, zip(of_pairs, depth_hypotheses(views, rows), strict=True))
    frames, starts = np.unique(views.frames[rows], return_index=True)
    starts = np.append(starts, len(rows))
    supports = [_support(views, rows, frames, starts, center, basis)
                for center, basis in zip(centers, bases, strict=True)]
    boxes = np.concatenate([np.empty(0, dtype=np.int64), *supports])
    of_boxes = np.repeat(np.arange(len(centers)), [len(support) for support in supports])
    found: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    is_free = np.zeros(len(views.frames), dtype=np.bool_)
    is_free[rows] = True
    viewpoints = views.viewpoints[views.frames]
    discarded = np.zeros(len(centers), dtype=np.bool_)
    while len(centers):
        gains = np.bincount(of_boxes[is_free[boxes]], minlength=len(centers))
        gains[discarded] = 0
        best = int(np.argmax(gains))
        if gains[best] < min_viewpoints:
            break
        discarded[best] = True
        own = supports[best]
        center, basis, support = _settle(views, rows[is_free[rows]], own[is_free[own]],
                                         centers[best], bases[best])
        if len(np.unique(viewpoints[support])) >= min_viewpoints:
            found.append((center, basis))
            is_free[support] = False
    if not found:
        return Landmarks.none()
    return Landmarks(np.array([center for center, _ in found]),
                     np.array([basis for _, basis in found]),
                     np.full(len(found), views.classes[rows[0]]))


def _settle(views: Views, free_rows: NDArray[np.int64], support: NDArray[np.int64],
            center: NDArray[np.float64], basis: NDArray[np.float64]
            ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Fit a hypothesis to its support while the support grows; return ellipsoid and support."""
    frames, starts = np.unique(views.frames[free_rows], return_index=True)
    starts = np.append(starts, len(free_rows))
    for _ in range(5):
        fit = fit_ellipsoid(views, support, center, basis)
        wider = _support(views, free_rows, frames, starts, fit.center, fit.basis)
        if len(wider) < len(support):
            break
        grows = len(wider) > len(support)
        center, basis, support = fit.center, fit.basis, wider
        if not grows:
            break
    return center, basis, support


@compiled
def _pair_hypotheses(views, rows, seeds, draws, origins, rays, radii):
    """Return centres (h, 3) and bases (h, 3, 3) of pairs, each of a seed and a random partner."""
    centers, bases = np.empty((len(seeds), 3)), np.empty((len(seeds), 3, 3))
    stamps = views.stamps_s[views.frames[rows]]
    places = np.searchsorted(rows, seeds)
    partners = np.empty(len(rows), dtype=np.int64)
    point = np.empty(3)
    pair = np.empty(2, dtype=np.int64)
    count, valid = 0, 0
    for number in range(len(seeds)):
        first = places[number]
        if number == 0 or places[number - 1] != first:
            low = np.searchsorted(stamps, stamps[first] - _MAX_GAP_S)
            high = np.searchsorted(stamps, stamps[first] + _MAX_GAP_S)
            valid = 0
            for second in range(low, high):
                if _meet(origins, rays, radii, first, second, point) > 0.0:
                    partners[valid] = second
                    valid += 1
        if valid == 0:
            continue
        second = partners[min(valid - 1, int(draws[number] * valid))]
        radius = _meet(origins, rays, radii, first, second, point)
        centers[count] = point
        bases[count] = radius * np.eye(3)
        pair[0], pair[1] = rows[first], rows[second]
        descend(views, pair, centers[count], bases[count], _PAIR_STEPS)
        count += 1
    return centers[:count].copy(), bases[:count].copy()


@compiled
def _meet(origins, rays, radii, first, second, point):
    """Write the point where two rays meet; return the object's radius, 0 if they do not meet."""
    cosine = (rays[first, 0] * rays[second, 0] + rays[first, 1] * rays[second, 1]
              + rays[first, 2] * rays[second, 2])
    if not _LEAST_COSINE <= cosine <= _GREATEST_COSINE:
        return 0.0
    along_first = along_second = 0.0
    for i in range(3):
        offset = origins[second, i] - origins[first, i]
        along_first += offset * rays[first, i]
        along_second += offset * rays[second, i]
    scale = 1.0 / (1.0 - cosine * cosine)
    depth_first = (along_first - cosine * along_second) * scale
    depth_second = (cosine * along_first - along_second) * scale
    if not (depth_first > _MIN_DEPTH_M and depth_second > _MIN_DEPTH_M):
        return 0.0
    radius_first, radius_second = radii[first] * depth_first, radii[second] * depth_second
    if max(radius_first, radius_second) > _MAX_RADIUS_RATIO * min(radius_first, radius_second):
        return 0.0
    radius = 0.5 * (radius_first + radius_second)
    miss = 0.0
    for i in range(3):
        on_first = origins[first, i] + depth_first * rays[first, i]
        on_second = origins[second, i] + depth_second * rays[second, i]
        miss += (on_first - on_second) ** 2
        point[i] = 0.5 * (on_first + on_second)
    return radius if miss < (_MAX_MISS * radius) ** 2 else 0.0


@compiled
def _support(views, rows, frames, starts, center, basis):
    """Return the best box (s,) in each frame that supports an ellipsoid."""
    found = np.empty(len(frames), dtype=np.int64)
    count = 0
    box = np.empty(4)
    for place in range(len(frames)):
        frame = frames[place]
        if not project_box(views.rotations[frame], views.translations[frame], center, basis, box):
            continue
        best = SUPPORT_IOU
        for row in rows[starts[place]:starts[place + 1]]:
            iou = box_iou(box, views.edges[row], views.bounds[frame])
            if iou > best:
                best = iou
                found[count] = row
        if best > SUPPORT_IOU:
            count += 1
    return found[:count].copy()
