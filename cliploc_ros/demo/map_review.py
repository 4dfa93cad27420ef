# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the map that the demo built with the room: found, missed and false objects."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.tum import parse_stamp_ns
from cliploc_ros.demo.truth import TrueFrame, TrueObject, true_ids
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S

#: A landmark this near to an object stands for it [m]. The objects are 0.2 m apart and more.
NEAR_M = 0.1


@dataclass(frozen=True)
class Found:
    """An object with a landmark of its class.

    Parameters
    ----------
    object_row, landmark : int
    offset_m : float
        Of the landmark's centre [m].
    size_ratio : float
        Mean radius of the landmark over that of the object.
    """

    object_row: int
    landmark: int
    offset_m: float
    size_ratio: float


@dataclass(frozen=True)
class MapReview:
    """A map compared with the objects of a room.

    Parameters
    ----------
    objects : tuple of TrueObject
    landmark_map : LandmarkMap
    found : tuple of Found
    missed : dict of int to str
        Reason by row of the object.
    false : dict of int to str
        What is there instead, by row of the landmark.
    """

    objects: tuple[TrueObject, ...]
    landmark_map: LandmarkMap
    found: tuple[Found, ...]
    missed: Mapping[int, str]
    false: Mapping[int, str]

    @property
    def landmark_of(self) -> dict[str, str]:
        """Return the id of the landmark of each found object, by the object's id."""
        return {self.objects[one.object_row].object_id:
                self.landmark_map.landmark_ids[one.landmark] for one in self.found}

    def summary(self) -> str:
        """Return the figures in one line."""
        text = (f'{len(self.found)} of {len(self.objects)} objects found, {len(self.missed)} '
                f'missed, {len(self.false)} false')
        if self.found:
            offsets_cm = [100 * one.offset_m for one in self.found]
            size_error = np.median([abs(one.size_ratio - 1) for one in self.found])
            text += (f'; centres {np.median(offsets_cm):.1f} cm off (median), '
                     f'{max(offsets_cm):.1f} cm at most; sizes {size_error:.0%} off (median)')
        return text


@dataclass(frozen=True)
class Sightings:
    """How the images show an object.

    Parameters
    ----------
    shown : int
        Images that show enough of it.
    detected : Counter of str
        Images with a detection of it, by the detection's class.
    """

    shown: int
    detected: 'Counter[str]'


def review_map(landmark_map: LandmarkMap, objects: Sequence[TrueObject],
               sightings: Mapping[str, Sightings], left_out: Sequence[Mapping[str, Any]]
               ) -> MapReview:
    """Return what a map found, missed and made up.

    Parameters
    ----------
    landmark_map : LandmarkMap
    objects : sequence of TrueObject
    sightings : dict of str to Sightings
        By id of the object.
    left_out : sequence of dict
        Of build_map's report: class_id, center and reason of each.
    """
    offsets_m = np.linalg.norm(np.array([one.center for one in objects])[:, None]
                               - landmark_map.centers, axis=2)
    is_class = np.array([one.class_id for one in objects])[:, None] == np.array(
        landmark_map.class_ids)
    costs = np.where(is_class & (offsets_m < NEAR_M), offsets_m, 2 * NEAR_M)
    pairs = [(int(row), int(landmark)) for row, landmark in zip(
        *linear_sum_assignment(costs), strict=True) if costs[row, landmark] < NEAR_M]
    found = tuple(Found(row, landmark, float(offsets_m[row, landmark]),
                        _radius(landmark_map.semi_axes[landmark])
                        / _radius(objects[row].semi_axes)) for row, landmark in pairs)
    false = {landmark: _what_is_there(landmark_map.class_ids[landmark], objects,
                                      offsets_m[:, landmark])
             for landmark in range(len(landmark_map))
             if landmark not in {one.landmark for one in found}}
    missed = {}
    for row, one in enumerate(objects):
        if row in {hit.object_row for hit in found}:
            continue
        instead = [landmark_map.class_ids[landmark] for landmark in false
                   if offsets_m[row, landmark] < NEAR_M]
        missed[row] = _why_missed(one, instead, sightings.get(one.object_id), left_out)
    return MapReview(tuple(objects), landmark_map, found, missed, false)


def count_sightings(frames: Sequence[TrueFrame], detections: PosedDetections
                    ) -> dict[str, Sightings]:
    """Return how often the images show each object, and as what it was detected."""
    stamps_ns = np.round(detections.stamps_s * NS_PER_S)
    shown: Counter[str] = Counter()
    detected: dict[str, Counter[str]] = {}
    for frame in frames:
        shown.update(box.object_id for box in frame.boxes)
        stamp_ns = parse_stamp_ns(frame.timestamp, 'truth.json')
        number = int(np.argmin(np.abs(stamps_ns - stamp_ns)))
        if abs(stamps_ns[number] - stamp_ns) > 1e3:  # the detections hold a stamp as a float
            continue  # the image was no keyframe
        rows = slice(*detections.frame_offsets[number:number + 2])
        ids = true_ids(detections.bboxes_xyxy[rows], frame.boxes)
        for one, class_number in sorted(set(zip(ids, detections.classes[rows], strict=True))):
            detected.setdefault(one, Counter())[detections.class_names[class_number]] += 1
    return {one: Sightings(count, detected.get(one, Counter())) for one, count in shown.items()}


def _radius(semi_axes: NDArray[np.float64]) -> float:
    """Return the radius of the sphere of equal volume."""
    return float(np.cbrt(np.prod(semi_axes)))


def _what_is_there(class_id: str, objects: Sequence[TrueObject], offsets_m: NDArray[np.float64]
                   ) -> str:
    nearest = int(np.argmin(offsets_m))
    one = objects[nearest]
    if offsets_m[nearest] >= NEAR_M:
        return f'nothing is there; {one.object_id} is {offsets_m[nearest]:.2f} m away'
    if one.class_id == class_id:
        return f'{one.object_id} a second time'
    return f'{one.object_id} is there: {one.label}'


def _why_missed(one: TrueObject, instead: Sequence[str], seen: Sightings | None,
                left_out: Sequence[Mapping[str, Any]]) -> str:
    """Return the first cause that applies, with how often the object was detected."""
    if seen is None:
        return 'no image shows it'
    names = ', '.join(f'{count} as {name}' for name, count in seen.detected.most_common())
    sightings = f'{seen.shown} images show it; detected in {names or "none"}'
    if instead:
        return f'mapped as {instead[0]}; {sightings}'
    near = [entry for entry in left_out
            if np.linalg.norm(np.array(entry['center']) - one.center) < NEAR_M]
    if near:
        best = max(near, key=lambda entry: entry['class_id'] == one.class_id)
        return f'left out as {best["class_id"]}, {best["reason"]}; {sightings}'
    return sightings
