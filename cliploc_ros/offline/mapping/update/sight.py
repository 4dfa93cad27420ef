# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which frames show the places of landmarks: near enough, in the image, and not hidden.

Walls are in no map. A place counts as shown only if the frame also shows another landmark close to
its direction that is not nearer.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.offline.mapping.landmarks import Landmarks, is_in_image, project_box
from cliploc_ros.offline.mapping.views import Views

# A place is in view if the frame shows another landmark this close to its direction, and not
# nearer: otherwise a wall may hide it. It is out of view if landmarks or boxes hide this share.
# Guesses.
_BESIDE_DEG, _HIDDEN_SHARE = 20.0, 0.4
# A landmark as near as this share of a place's distance is beside the place, not before it.
_BESIDE_SHARE = 0.8
# A class with fewer boxes is taken to be seen at the sizes of its boxes and of all classes only.
_FEW_BOXES = 20
_LEAST_QUANTILE = 0.1
# Points in a box at which the kernel asks whether something hides it: a 5 x 5 grid in the ellipse.
_GRID = np.array([(x, y) for x in (-0.8, -0.4, 0.0, 0.4, 0.8) for y in (-0.8, -0.4, 0.0, 0.4, 0.8)
                  if x * x + y * y < 1.0])


class Sight(NamedTuple):
    """In how many viewpoints each of L places was in view, and its landmark seen."""

    #: (L,): viewpoints
    expected: NDArray[np.int64]
    seen: NDArray[np.int64]
    #: (L,): frames
    expected_frames: NDArray[np.int64]
    seen_frames: NDArray[np.int64]

    @property
    def seen_ratio(self) -> NDArray[np.float64]:
        """Return the share (L,) of the frames in view in which each landmark was seen."""
        return np.asarray(self.seen_frames / np.maximum(1, self.expected_frames))

    def select(self, rows: slice | NDArray[np.int64]) -> 'Sight':
        """Return some of the places."""
        return Sight(*(column[rows] for column in self))


def look_for(views: Views, places: Landmarks, shown: NDArray[np.int64],
             is_solid: NDArray[np.bool_]) -> Sight:
    """Return in which frames places were in view, and in which of them their landmark was seen.

    Class -1 is one that no box has. Solid places have an object, which may hide others.
    """
    count = len(places.centers)
    extents = _least_extents(views, int(places.classes.max(initial=0)))
    least = np.where(places.classes < 0, extents[-1], extents[places.classes])
    radii = np.linalg.norm(places.bases, axis=1).max(axis=1, initial=0.0)
    frames, rows = _in_view(
        views, places.centers, places.bases, radii, 2.0 * radii / np.maximum(least, 1e-6), least,
        is_solid, shown, np.cos(np.radians(_BESIDE_DEG)), _HIDDEN_SHARE)
    seen_rows = np.nonzero(shown >= 0)[0]
    seen_keys = np.unique(views.frames[seen_rows] * count + shown[seen_rows])
    keys = np.union1d(frames * count + rows, seen_keys)

    def per_viewpoint(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the numbers of viewpoints and of frames (L,) among keys frame * L + place."""
        frames, rows = np.divmod(keys, max(count, 1))
        distinct = np.unique(views.viewpoints[frames] * count + rows) % max(count, 1)
        return np.bincount(distinct, minlength=count), np.bincount(rows, minlength=count)

    (expected, expected_frames), (seen, seen_frames) = map(per_viewpoint, (keys, seen_keys))
    return Sight(expected, seen, expected_frames, seen_frames)


def _least_extents(views: Views, last_class: int) -> NDArray[np.float64]:
    """Return from which size on boxes are detected, by class, on the plane z = 1.

    The last entry is that of all classes together.
    """
    sides = np.maximum(views.edges[:, 2:] - views.edges[:, :2], 0.0)
    extents = np.sqrt(sides.prod(axis=1))
    whole = ~views.is_open.any(axis=1)
    overall = float(np.quantile(extents[whole], _LEAST_QUANTILE)) if whole.any() else 0.0
    result = np.full(last_class + 2, overall)
    for number in range(last_class + 1):
        own = extents[whole & (views.classes == number)]
        if len(own) >= _FEW_BOXES:
            result[number] = np.quantile(own, _LEAST_QUANTILE)
        elif len(own):
            result[number] = max(overall, float(own.min()))
    return result


@compiled
def _in_view(views, centers, bases, radii, reaches, least, is_solid, shown, beside_cosine,
             hidden_share):
    """Return frame and row of each place in view."""
    count = len(centers)
    farthest = reaches.max() if count else 0.0
    boxes, offsets = np.empty((count, 4)), np.empty((count, 3))
    distances, near = np.empty(count), np.empty(count, dtype=np.int64)
    was_seen = np.zeros(count, dtype=np.bool_)
    capacity, found = 1024, 0
    frames, rows = np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64)
    for frame in range(len(views.rotations)):
        first, last = views.offsets[frame], views.offsets[frame + 1]
        in_front = _project_near(views.rotations[frame], views.translations[frame], centers, bases,
                                 farthest, boxes, offsets, distances, near)
        for row in range(first, last):
            if shown[row] >= 0:
                was_seen[shown[row]] = True
        for i in range(in_front):
            place = near[i]
            box = boxes[place]
            if distances[place] > reaches[place] or not is_in_image(box, views.bounds[frame]):
                continue
            # large enough to be detected
            if (box[2] - box[0]) * (box[3] - box[1]) < least[place] * least[place]:
                continue
            if not _has_beside(place, near[:in_front], was_seen, offsets, distances,
                               beside_cosine):
                continue
            if _hidden(place, near[:in_front], boxes, distances, radii, is_solid, shown,
                       views.edges, first, last) > hidden_share:
                continue
            if found == capacity:
                capacity *= 2
                frames = np.append(frames, np.empty_like(frames))
                rows = np.append(rows, np.empty_like(rows))
            frames[found], rows[found] = frame, place
            found += 1
        for row in range(first, last):
            if shown[row] >= 0:
                was_seen[shown[row]] = False
    return frames[:found].copy(), rows[:found].copy()


@compiled
def _project_near(rotation, translation, centers, bases, farthest, boxes, offsets, distances,
                  near):
    """Write box, offset and distance of the places in front of a camera; return their number."""
    count = 0
    for place in range(len(centers)):
        z = translation[2]
        for k in range(3):
            z += rotation[2, k] * centers[place, k]
        if not 0.0 < z <= farthest:
            continue
        if not project_box(rotation, translation, centers[place], bases[place], boxes[place]):
            continue
        square = 0.0
        for i in range(3):
            value = translation[i]
            for k in range(3):
                value += rotation[i, k] * centers[place, k]
            offsets[place, i] = value
            square += value * value
        distances[place] = sqrt(square)
        near[count] = place
        count += 1
    return count


@compiled
def _has_beside(place, near, was_seen, offsets, distances, beside_cosine):
    """Tell whether a frame shows another landmark beside a place or behind it."""
    for other in near:
        if other == place or not was_seen[other]:
            continue
        if distances[other] < _BESIDE_SHARE * distances[place]:
            continue
        cosine = ((offsets[other] * offsets[place]).sum()
                  / (distances[other] * distances[place]))
        if cosine > beside_cosine:
            return True
    return False


@compiled
def _hidden(place, near, boxes, distances, radii, is_solid, shown, edges, first, last):
    """Return which share of a place landmarks in front of it hide, or boxes of no landmark."""
    box = boxes[place]
    x0, y0 = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    a, b = 0.5 * (box[2] - box[0]), 0.5 * (box[3] - box[1])
    count = 0
    for k in range(len(_GRID)):
        x, y = x0 + a * _GRID[k, 0], y0 + b * _GRID[k, 1]
        is_hidden = False
        for other in near:
            if (is_solid[other] and other != place
                    and distances[other] + radii[other] < distances[place]
                    and _covers(boxes[other], x, y)):
                is_hidden = True
                break
        if not is_hidden:
            for row in range(first, last):
                if shown[row] < 0 and _covers(edges[row], x, y):
                    is_hidden = True
                    break
        if is_hidden:
            count += 1
    return count / len(_GRID)


@compiled
def _covers(box, x, y):
    """Tell whether a point lies in the ellipse of a box."""
    dx = (2.0 * x - box[0] - box[2]) / (box[2] - box[0])
    dy = (2.0 * y - box[1] - box[3]) / (box[3] - box[1])
    return dx * dx + dy * dy < 1.0
