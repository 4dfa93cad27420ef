# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What became of each old landmark, and which objects are new."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.updating.alignment import has_moved
from cliploc_ros.mapping.updating.identity import Identities
from cliploc_ros.mapping.updating.judging import Judged
from cliploc_ros.mapping.updating.known import Known
from cliploc_ros.mapping.updating.objects import Objects
from cliploc_ros.mapping.updating.options import UpdateOptions


class Fates(NamedTuple):
    """Rows of old landmarks by what became of them, and new objects."""

    #: of int
    confirmed: NDArray[np.int64]
    moved: NDArray[np.int64]
    missing: NDArray[np.int64]
    not_observed: NDArray[np.int64]
    new: NDArray[np.int64]  #: of int: objects that are no old landmark
    objects: NDArray[np.int64]  #: (L,): the object that each old landmark is, -1 for none
    rivals: dict[int, tuple[int, ...]]  #: Old landmarks that an object could be as well


def decide_fates(known: Known, judged: Judged, objects: Objects, identities: Identities,
                 options: UpdateOptions) -> Fates:
    """Return what became of each old landmark."""
    numbers = identities.objects
    found = numbers >= 0
    elsewhere = found.copy()
    rows = np.nonzero(found)[0]
    elsewhere[rows] = objects.owners[numbers[rows]] != rows
    # an object that is a little off its place was only mapped badly
    rows = np.nonzero(elsewhere)[0]
    elsewhere[rows] = has_moved(known.select(rows), objects.refits.select(numbers[rows]), options)
    missing = ~found & (judged.is_gone | judged.is_there)
    return Fates(
        np.nonzero(found & ~elsewhere)[0], np.nonzero(elsewhere)[0], np.nonzero(missing)[0],
        np.nonzero(~found & ~missing)[0],
        np.setdiff1d(np.arange(len(objects.owners)), numbers[found]), numbers, identities.rivals)
