# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether cameras are mounted on a robot as stated: what one sees has to fit the others."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from cliploc_ros.core.observation import Observation

# A mount is wrong where accepted poses explain less than this share of what its camera saw, and
# more than twice as much of what the others did. With four cameras among simulated objects, a
# right mount has 1.0, one that is turned by 2 degrees .8, by 5 degrees .1, by more 0 to .1.
_LEAST_SHARE = 0.3
# Of instants, and of objects in all of them; before, nothing is said.
_LEAST_INSTANTS, _MOST_INSTANTS, _LEAST_OBJECTS = 5, 20, 15


class MountCheck:
    """Counts over instants how much of what each camera sees the accepted poses explain."""

    def __init__(self) -> None:
        self._instants: deque[dict[str, tuple[int, int]]] = deque(maxlen=_MOST_INSTANTS)

    def add(self, seen: Sequence[Observation], known: Sequence[int], matched: Sequence[int]
            ) -> None:
        """Take in an instant: of each camera, objects of the map's classes and those matched."""
        self._instants.append({one.camera_name: (of_map, found) for one, of_map, found
                               in zip(seen, known, matched, strict=True)})

    @property
    def wrong(self) -> list[str]:
        """Return the names of the cameras whose mount cannot be right."""
        names = dict.fromkeys(name for instant in self._instants for name in instant)
        counts = {name: np.array([instant[name] for instant in self._instants if name in instant])
                  for name in names}
        every = np.sum([of_one.sum(axis=0) for of_one in counts.values()], axis=0)
        found = []
        for name, of_one in counts.items():
            known, matched = of_one.sum(axis=0)
            others_known, others_matched = every - (known, matched)
            if (len(of_one) >= _LEAST_INSTANTS and min(known, others_known) >= _LEAST_OBJECTS
                    and matched < _LEAST_SHARE * known
                    and matched / known < 0.5 * others_matched / others_known):
                found.append(name)
        return found
