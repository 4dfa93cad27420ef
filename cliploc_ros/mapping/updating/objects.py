# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The objects that a recording shows: old landmarks in their places, and finds."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.mapping.evidence import Evidence, gather_evidence
from cliploc_ros.mapping.landmarks import Landmarks, join_landmarks
from cliploc_ros.mapping.updating.finding import close_pairs
from cliploc_ros.mapping.updating.judging import Judged
from cliploc_ros.mapping.updating.known import Known, Refits, refit
from cliploc_ros.mapping.updating.options import UpdateOptions
from cliploc_ros.mapping.updating.sight import Sight
from cliploc_ros.mapping.views import Views


class Objects(NamedTuple):
    """What the recording shows: m objects, n boxes."""

    refits: Refits  #: Where they are
    owners: NDArray[np.int64]  #: (m,): the old landmark in whose place it was seen, -1 for none
    #: For each, the old landmarks that it may be although it is a little off their place
    near: tuple[frozenset[int], ...]
    shown: NDArray[np.int64]  #: (n,): the object that each box shows, -1 for none
    sight: Sight
    evidence: Evidence
    given: tuple[LandmarkDetails, ...]  #: Classes and source of the finds

    @property
    def landmarks(self) -> Landmarks:
        """Return the objects as landmarks."""
        return self.refits.landmarks


def gather_objects(views: Views, known: Known, judged: Judged, options: UpdateOptions) -> Objects:
    """Return the objects that the recording shows."""
    count, finds = len(known.sigmas), judged.finds
    in_place = np.nonzero(judged.is_there)[0]
    places = np.concatenate([in_place, count + np.arange(len(finds.details))])
    numbers = np.full(count + len(finds.details) + 1, -1, dtype=np.int64)
    numbers[places] = np.arange(len(places))
    shown = numbers[judged.shown]
    refits = refit(views, join_landmarks(known.landmarks.select(in_place), finds.landmarks), shown,
                   options.mapping.min_viewpoints)
    near: list[set[int]] = [set() for _ in places]
    named = set(zip(known.owners.tolist(), known.named.classes.tolist(), strict=True))
    for new, row, _ in close_pairs(finds.landmarks, known.landmarks,
                                   options.mapping.merge_distance):
        if not judged.is_there[row] and (row, int(finds.landmarks.classes[new])) in named:
            near[len(in_place) + new].add(row)
    return Objects(
        refits, np.concatenate([in_place, np.full(len(finds.details), -1, dtype=np.int64)]),
        tuple(map(frozenset, near)), shown, judged.sight.select(places),
        gather_evidence(views, refits.landmarks, shown),
        (LandmarkDetails(),) * len(in_place) + finds.details)
