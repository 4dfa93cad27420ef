# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether objects are still in their places, given the looks that should have shown them.

One model serves the watch, the update of landmarks, and the update of keyframes. A detector finds
some objects in each image and others rarely; the same holds for points. The share of looks that
find an object has a beta distribution, updated by each look. If the object is present, the
probability of k consecutive misses is B(a, b + k) / B(a, b). If it is gone, a look may still find
it by chance.
"""

from collections import deque
from collections.abc import Iterable
from math import log
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, expit

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.visibility import SIDES, Expected

Values = float | NDArray[Any]
#: Share of the objects that are usually still in their place. Chosen.
STAYS = 0.9
#: A usual share counts as this number of looks, as an object may be hard to see from one side.
#: Chosen.
WORTH = 4.0
# The watch: prior of the share of looks that find a present landmark: mean over all landmarks,
# weight of this mean in looks, and weight of the overall share (or of the map's seen_ratio) in
# looks where a single landmark is judged. Chosen.
_FOUND, _OF_FOUND, _OF_SHARE = 0.75, 10.0, 3.0
# Limits of this share.
_SHARES = (0.1, 0.95)
# Prior probability that a landmark is gone, and share of looks in which a detection matches a
# landmark that is gone by chance. Chosen.
_GONE, _BY_CHANCE = 0.05, 0.05
# A landmark is reported at this probability. The number of counted sightings is limited, so that a
# landmark that is removed after a day is soon reported.
_NAMED, _MOST_SEEN = 0.8, 15.0
# The map is out of date at a place if, of the landmarks that this number of last looks expected,
# this number and this share are gone, counted by their probabilities.
_HERE, _LEAST_GONE, _LEAST_SHARE = 10, 2.0, 0.25


def log_evidence(found: Values, missed: Values, seen: Values, misses: Values) -> Values:
    """Return the logarithm of the beta-binomial probability of looks at an object in its place.

    `found` and `missed` are the parameters of the prior of the share of looks that find it, `seen`
    and `misses` the numbers of looks. The binomial coefficient is omitted.
    """
    return betaln(found + seen, missed + misses) - betaln(found, missed)


def probability_there(seen: NDArray[Any], expected: NDArray[Any], shares: Values, worth: float,
                      chance: float) -> NDArray[np.float64]:
    """Return for each place (L,) the probability that its object is there.

    Parameters
    ----------
    seen, expected : ndarray (L,)
        Numbers of looks that found the object, and of looks that should have.
    shares : float or ndarray (L,)
        Usual share of the looks that find an object in its place.
    worth : float
        Number of looks that a usual share counts as.
    chance : float
        Share of the looks that find an object that is gone.
    """
    there, away = (log_evidence(looks * share, looks * (1.0 - share), seen, expected - seen)
                   for looks, share in ((worth, shares), (WORTH, chance)))
    return np.asarray(expit(log(STAYS / (1.0 - STAYS)) + there - away))


class _Record(NamedTuple):
    """Weighted numbers of looks that found and that missed a landmark."""

    found: float = 0.0
    missed: float = 0.0  #: Misses before the last sighting
    misses: float = 0.0  #: Misses since the last sighting
    seen_from: int = 0  #: Sides from which it was seen, as bits

    def gone(self, share: float) -> float:
        """Return the probability that it is gone, given the prior share of looks that find it.

        Misses are counted up to the number with the strongest evidence. Further misses would be
        evidence that it is present but rarely found, because a landmark that is gone is sometimes
        matched by chance. A removed landmark would then no longer be reported after some hundred
        looks.
        """
        found = _OF_SHARE * share + self.found
        missed = _OF_SHARE * (1.0 - share) + self.missed
        misses = min(self.misses, max(0.0, found / _BY_CHANCE - found - missed))
        there = log_evidence(found, missed, 0.0, misses)
        return float(expit(log(_GONE / (1.0 - _GONE)) + misses * log(1.0 - _BY_CHANCE) - there))


class Missing:
    """Finds landmarks that are gone, from the looks that should have shown them."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        self._details = landmark_map.details
        self._records: dict[int, _Record] = {}
        self._expected: deque[list[int]] = deque(maxlen=_HERE)

    def add(self, expected: Expected, weight: float) -> None:
        """Count a look at a right pose; its weight is 1 if it is independent of earlier looks."""
        for landmark, was_seen, in_sight, side in zip(*(column.tolist() for column in expected),
                                                      strict=True):
            record = self._records.get(landmark, _Record())
            if was_seen:
                keep = min(1.0, _MOST_SEEN / (record.found + weight))
                self._records[landmark] = _Record(
                    keep * (record.found + weight), keep * (record.missed + record.misses),
                    seen_from=record.seen_from | 1 << side)
            # count misses only from sides where it was seen: a detector may not recognize a
            # television from behind. A landmark that was never seen is missed from all sides.
            elif in_sight and (not record.seen_from or any(
                    record.seen_from >> (side + step) % SIDES & 1 for step in (-1, 0, 1))):
                self._records[landmark] = record._replace(misses=record.misses + weight)
        if len(expected.landmarks):
            self._expected.append(expected.landmarks.tolist())

    def named(self) -> list[int]:
        """Return the missing landmarks in decreasing order of probability."""
        gone = self._gone(self._records)
        return sorted((landmark for landmark in gone if gone[landmark] >= _NAMED),
                      key=lambda landmark: -gone[landmark])

    @property
    def is_outdated(self) -> bool:
        """Check whether the map is out of date at the place of the last looks."""
        here = {landmark for look in self._expected for landmark in look}
        gone = sum(self._gone(here).values())
        return bool(gone >= _LEAST_GONE and gone >= _LEAST_SHARE * len(here))

    def _gone(self, landmarks: Iterable[int]) -> dict[int, float]:
        """Return the probability that each landmark is gone."""
        # overall share of the landmarks that were seen; the first sighting is not counted, because
        # it selects them
        seen = [record for record in self._records.values() if record.found > 0.0]
        found = sum(max(0.0, record.found - 1.0) for record in seen)
        missed = sum(record.missed for record in seen)
        overall = (_OF_FOUND * _FOUND + found) / (_OF_FOUND + found + missed)
        result = {}
        for landmark in landmarks:
            ratio = self._details[landmark].seen_ratio if self._details else None
            share = overall if ratio is None else min(overall, ratio)
            result[landmark] = self._records.get(landmark, _Record()).gone(
                min(max(share, _SHARES[0]), _SHARES[1]))
        return result
