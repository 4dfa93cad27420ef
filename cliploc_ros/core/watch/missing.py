# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks are no longer there, as looks that expect them and do not see them tell.

A detector finds some landmarks in each image and others hardly ever. The share of looks that find
a landmark has a beta distribution, which each look narrows down. Then the probability of k misses
in a row is B(a, b + k) / B(a, b), if the landmark is there.
"""

from collections import deque
from math import exp, log
from typing import NamedTuple

from scipy.special import betaln

from cliploc_ros.core.watch.expectation import Expected

# Beta distribution of the share of looks that find a landmark in view: of maps whose landmarks
# have no seen_ratio.
_FOUND, _NOT_FOUND = 3.0, 1.0
# Looks that the seen_ratio of a map stands for, and the probability that a landmark is gone before
# any look. Guesses.
_OF_MAP, _GONE = 4.0, 0.05
# A landmark that is gone is matched by chance in this share of the looks. A guess.
_BY_CHANCE = 0.05
# Named from this probability on. Not more sightings than this are counted, so a landmark that is
# taken away after a day is soon missed.
_NAMED, _MOST_SEEN = 0.8, 15.0

# The map is out of date where this many landmarks and this share of those that the last looks
# expected are gone, by their probabilities.
_HERE, _LEAST_GONE, _LEAST_SHARE = 10, 2.0, 0.2


class _Record(NamedTuple):
    found: float = _FOUND
    not_found: float = _NOT_FOUND
    misses: float = 0.0  #: Since it was seen last

    @property
    def gone(self) -> float:
        """Return the probability that the landmark is gone."""
        there = betaln(self.found, self.not_found + self.misses) - betaln(
            self.found, self.not_found)
        odds = log(_GONE / (1.0 - _GONE)) + self.misses * log(1.0 - _BY_CHANCE) - there
        return float(1.0 / (1.0 + exp(-odds)))


class Missing:
    """What looks said of each landmark that they expected."""

    def __init__(self) -> None:
        self._records: dict[int, _Record] = {}
        self._expected: deque[list[int]] = deque(maxlen=_HERE)

    def add(self, expected: Expected, weight: float) -> None:
        """Count a look at a right pose, 1 for one that shares no errors with earlier ones."""
        for landmark, was_seen, in_sight in zip(*(one.tolist() for one in expected), strict=True):
            one = self._records.get(landmark, _Record())
            if was_seen:
                self._records[landmark] = _Record(
                    min(one.found + weight, _MOST_SEEN), one.not_found + one.misses)
            elif in_sight:
                self._records[landmark] = one._replace(misses=one.misses + weight)
        if len(expected.landmarks):
            self._expected.append(expected.landmarks.tolist())

    def named(self) -> list[int]:
        """Return the landmarks that are missing, those first that are most certainly gone."""
        gone = {landmark: one.gone for landmark, one in self._records.items() if one.misses}
        return sorted((one for one in gone if gone[one] >= _NAMED), key=lambda one: -gone[one])

    @property
    def is_outdated(self) -> bool:
        """Return whether the map is out of date at the place of the last looks."""
        here = {landmark for look in self._expected for landmark in look}
        gone = sum(self._records[one].gone for one in here if one in self._records)
        return bool(gone >= _LEAST_GONE and gone >= _LEAST_SHARE * len(here))
