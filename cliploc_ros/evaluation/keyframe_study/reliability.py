# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Is a probability what it says: shares of right poses by probability, and false accepts."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.evaluation.keyframe_study.asking import Row
from cliploc_ros.evaluation.summary import wilson_interval

#: A pose further off is wrong [m].
WRONG_M = 1.0
_BINS = (0.0, 0.01, 0.1, 0.5, 0.9, 0.97, 0.99, 1.0)


def false_accepts(rows: Sequence[Row]) -> list[str]:
    """Return the accepted poses of each case and way, and how many of them are wrong."""
    lines = [f'{"case":45} {"way":10} queries  accepted  false  95 % of the queries']
    for case in [*dict.fromkeys(row.case for row in rows), '']:
        of_case = [row for row in rows if not case or row.case == case]
        for way in of_case[0].ways if of_case else ():
            accepted = [row.ways[way] for row in of_case if way in row.ways
                        and row.ways[way].accepted]
            false = sum(not one.error_m < WRONG_M for one in accepted)
            low, high = wilson_interval(false, len(of_case))
            lines.append(f'{case or "all":45} {way:10} {len(of_case):7}  {len(accepted):8}  '
                         f'{false:5}  {low:.3f} to {high:.3f}')
    return lines


def reliability(rows: Sequence[Row]) -> list[str]:
    """Return the share of right poses over the probability: of keyframes, and of each answer."""
    def by_keyframes(row: Row) -> tuple[float, float] | None:
        return (row.evidence['chance'], row.evidence['error_m']) if row.evidence else None

    def by_way(way: str) -> Callable[[Row], tuple[float, float] | None]:
        return lambda row: (row.ways[way].confidence, row.ways[way].error_m) \
            if row.ways[way].confidence > 0.0 else None
    lines = [f'{"probability of":22} from    to     poses   mean  right  95 %']
    for name, get in (("the keyframes' pose", by_keyframes), ('landmarks', by_way('landmarks')),
                      ('both', by_way('both'))):
        found = np.array([pair for row in rows if (pair := get(row)) is not None]).reshape(-1, 2)
        lines += _bins(name, found[:, 0], found[:, 1] < WRONG_M)
    return lines


def _bins(name: str, chances: NDArray[np.float64], right: NDArray[np.bool_]) -> list[str]:
    lines = []
    for low, high in pairwise(_BINS):
        inside = (chances >= low) & ((chances < high) | (high == _BINS[-1]))
        if count := int(inside.sum()):
            least, most = wilson_interval(int(right[inside].sum()), count)
            lines.append(f'{name:22} {low:4.2f}  {high:4.2f}  {count:6}  '
                         f'{chances[inside].mean():5.3f}  {right[inside].mean():5.3f}  '
                         f'{least:.3f} to {most:.3f}')
    return lines
