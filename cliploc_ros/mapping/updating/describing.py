# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Put into words what became of each landmark."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.mapping.updating.fates import Fates
from cliploc_ros.mapping.updating.judging import Judged
from cliploc_ros.mapping.updating.objects import Objects
from cliploc_ros.mapping.updating.report import UpdatedLandmark


def describe(old: LandmarkMap, updated: LandmarkMap, objects: Objects, fates: Fates,
             judged: Judged) -> dict[str, tuple[UpdatedLandmark, ...]]:
    """Return the lists of an UpdateReport.

    Parameters
    ----------
    old, updated : LandmarkMap
    objects : Objects
    fates : Fates
    judged : Judged
    """
    places = dict(zip(updated.landmark_ids, range(len(updated)), strict=True))
    seen_of, expected_of = judged.sight.seen_frames, judged.sight.expected_frames

    def item(row: int, evidence: str) -> UpdatedLandmark:
        """Return one landmark of the old map."""
        name, center = old.landmark_ids[row], old.centers[row]
        now = updated.centers[places[name]] if name in places else center
        last_seen = old.details[row].last_seen if old.details else None
        rivals = fates.rivals.get(int(fates.objects[row]), ()) if row in fates.moved else ()
        return UpdatedLandmark(name, old.labels[row], old.class_ids[row], _rounded(now),
                               round(float(np.linalg.norm(now - center)), 3), evidence, last_seen,
                               tuple(old.landmark_ids[rival] for rival in rivals))

    def in_place(row: int) -> str:
        return f'expected in {expected_of[row]} frames, seen in {seen_of[row]}'

    def moved(row: int) -> str:
        number = fates.objects[row]
        way = float(np.linalg.norm(objects.landmarks.centers[number] - old.centers[row]))
        left = ('an object of another look is in its old place' if judged.is_there[row]
                else f'old place {in_place(row)}')
        return (f'moved by {way:.2f} m: {left}; new place seen in '
                f'{objects.sight.seen_frames[number]} of {objects.sight.expected_frames[number]}')

    return {
        'confirmed': tuple(item(row, _seen(objects, fates.objects[row]))
                           for row in fates.confirmed),
        'moved': tuple(item(row, moved(row)) for row in fates.moved),
        'missing': tuple(item(row, in_place(row)) for row in fates.missing),
        'not_observed': tuple(item(row, in_place(row)) for row in fates.not_observed),
        'new': tuple(_new(updated, objects, fates)),
    }


def _seen(objects: Objects, number: int) -> str:
    return (f'expected in {objects.sight.expected_frames[number]} frames, seen in '
            f'{objects.sight.seen_frames[number]}')


def _new(updated: LandmarkMap, objects: Objects, fates: Fates) -> Iterable[UpdatedLandmark]:
    for place, number in enumerate(fates.new, len(updated) - len(fates.new)):
        yield UpdatedLandmark(updated.landmark_ids[place], updated.labels[place],
                              updated.class_ids[place], _rounded(updated.centers[place]), 0.0,
                              _seen(objects, int(number)), updated.details[place].last_seen)


def _rounded(center: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 3) for value in center)
    return x, y, z
