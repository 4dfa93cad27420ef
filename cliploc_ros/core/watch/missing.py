# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks are no longer there, as looks that expect them and do not see them tell.

A detector finds some landmarks in each image and others hardly ever. The share of looks that find
a landmark has a beta distribution, which each look narrows down. Then the probability of k misses
in a row is B(a, b + k) / B(a, b), if the landmark is there.
"""

from collections import deque
from collections.abc import Iterable
from math import exp, log
from typing import NamedTuple

from scipy.special import betaln

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.watch.expectation import SIDES, Expected

# The share of looks that find a landmark which is there: its mean before any look, the looks that
# this mean stands for, and the looks that the share of all landmarks, or the seen_ratio of a map,
# stands for where one landmark is judged. Guesses.
_FOUND, _OF_FOUND, _OF_SHARE = 0.75, 10.0, 3.0
_SHARES = (0.1, 0.95)
# Probability that a landmark is gone before any look, and the share of looks in which something is
# matched with one that is gone by chance. Guesses.
_GONE, _BY_CHANCE = 0.05, 0.05
# Named from this probability on. Not more sightings than this are counted, so a landmark that is
# taken away after a day is soon missed.
_NAMED, _MOST_SEEN = 0.8, 15.0
# The map is out of date where this many landmarks and this share of those that the last looks
# expected are gone, by their probabilities.
_HERE, _LEAST_GONE, _LEAST_SHARE = 10, 2.0, 0.25


class _Record(NamedTuple):
    """Looks that found a landmark and that missed it, by their weights."""

    found: float = 0.0
    missed: float = 0.0  #: Before it was seen last
    misses: float = 0.0  #: Since then
    seen_from: int = 0  #: The sides from which it was seen, a bit each

    def gone(self, share: float) -> float:
        """Return the probability that it is gone, where looks find a landmark at a share."""
        found = _OF_SHARE * share + self.found
        missed = _OF_SHARE * (1.0 - share) + self.missed
        there = betaln(found, missed + self.misses) - betaln(found, missed)
        odds = log(_GONE / (1.0 - _GONE)) + self.misses * log(1.0 - _BY_CHANCE) - there
        return float(1.0 / (1.0 + exp(-odds)))


class Missing:
    """What looks said of each landmark that they expected."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        self._details = landmark_map.details
        self._records: dict[int, _Record] = {}
        self._expected: deque[list[int]] = deque(maxlen=_HERE)

    def add(self, expected: Expected, weight: float) -> None:
        """Count a look at a right pose, 1 for one that shares no errors with earlier ones."""
        for landmark, was_seen, in_sight, side in zip(*(one.tolist() for one in expected),
                                                      strict=True):
            one = self._records.get(landmark, _Record())
            if was_seen:
                keep = min(1.0, _MOST_SEEN / (one.found + weight))
                self._records[landmark] = _Record(
                    keep * (one.found + weight), keep * (one.missed + one.misses),
                    seen_from=one.seen_from | 1 << side)
            # a television does not show from behind; one that was never seen may from everywhere
            elif in_sight and (not one.seen_from or any(
                    one.seen_from >> (side + step) % SIDES & 1 for step in (-1, 0, 1))):
                self._records[landmark] = one._replace(misses=one.misses + weight)
        if len(expected.landmarks):
            self._expected.append(expected.landmarks.tolist())

    def named(self) -> list[int]:
        """Return the landmarks that are missing, those first that are most certainly gone."""
        gone = self._gone(self._records)
        return sorted((one for one in gone if gone[one] >= _NAMED), key=lambda one: -gone[one])

    @property
    def is_outdated(self) -> bool:
        """Return whether the map is out of date at the place of the last looks."""
        here = {landmark for look in self._expected for landmark in look}
        gone = sum(self._gone(here).values())
        return bool(gone >= _LEAST_GONE and gone >= _LEAST_SHARE * len(here))

    def _gone(self, landmarks: Iterable[int]) -> dict[int, float]:
        """Return the probability that each of some landmarks is gone."""
        # of those that were seen, without the sighting that makes them so
        seen = [one for one in self._records.values() if one.found > 0.0]
        found = sum(max(0.0, one.found - 1.0) for one in seen)
        missed = sum(one.missed for one in seen)
        overall = (_OF_FOUND * _FOUND + found) / (_OF_FOUND + found + missed)
        result = {}
        for landmark in landmarks:
            ratio = self._details[landmark].seen_ratio if self._details else None
            share = overall if ratio is None else min(overall, ratio)
            result[landmark] = self._records.get(landmark, _Record()).gone(
                min(max(share, _SHARES[0]), _SHARES[1]))
        return result
