# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge stored records by the package's verdict: tables and the figure of reliability."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.recognition import NO_OBJECTS, objects_there
from cliploc_ros.core.combination import combine
from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.evaluation.figures import add_legend, new_axes, save_figure
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trust import draw_reliability, within_ellipsoid
from studies.keyframes.records import Record, StoredCase, locate, read_case

WAYS = ('objects', 'keyframes', 'both')
LIMITS_M = (0.1, 0.25, 0.5, 1.0)
#: A pose further off is wrong [m].
WRONG_M = 1.0
_NOTHING = Relocalization(False, 'not searched')


@dataclass(frozen=True)
class Outcome:
    """One way's answer to a query.

    Parameters
    ----------
    site, place, case : str
    number : int
        Of the query.
    way : str
    errors_m : tuple of float
        Distance from each true pose; infinite without a pose, or if it is not in the map.
    accepted : bool
    confidence, nees : float
        The NEES is infinite without a pose or truth.
    refusal, reason, source : str
        Kind and text of a refusal; what the pose comes from.
    """

    site: str
    place: str
    case: str
    number: int
    way: str
    errors_m: tuple[float, ...]
    accepted: bool
    confidence: float
    nees: float
    refusal: str
    reason: str
    source: str

    @property
    def family(self) -> str:
        """Return the family of the case."""
        return self.case.partition(':')[0]


def decide(case: StoredCase, record: Record, way: str) -> Relocalization:
    """Return the package's answer to a record by objects, by keyframes, or by both."""
    found = _by_objects(case, record) if way != 'keyframes' else _NOTHING
    last = record.looks[-1]
    if way == 'objects' or last.seen is None:
        return found
    there = NO_OBJECTS if way == 'keyframes' else objects_there(
        case.landmark_map, last.searched.observation, last.seen.map_from_camera)
    return combine(found, last.seen, there, record.options)


@lru_cache(maxsize=1)
def _by_objects(case: StoredCase, record: Record) -> Relocalization:
    """Return the answer at the last look of a robot that looked before, as a session gives it."""
    looks, found = Looks(), _NOTHING
    for count, look in enumerate(record.looks, start=1):
        found = locate(case.landmark_map, record.options,
                       [one.searched for one in record.looks[:count]], looks)
        if found.map_from_camera is not None:
            looks = looks.with_look(look.searched.observation, found.map_from_camera,
                                    found.confidence)
    return found


def judge(path: Path) -> list[Outcome]:
    """Return the outcomes of the records of a file."""
    stored = read_case(path)
    return [] if stored is None else [
        _outcome(stored.place, stored.name, record, way,
                 decide(stored, record, way))
        for record in stored.records for way in WAYS]


def _outcome(place: str, case: str, record: Record, way: str, found: Relocalization) -> Outcome:
    pose, nees = found.map_from_camera, np.inf
    errors = tuple(np.inf if pose is None else pose_error(pose, truth)[0]
                   for truth in record.truths) or (np.inf,)
    if pose is not None and found.covariance is not None and record.truths:
        nees = normalized_square(pose, found.covariance, record.truths[0])
    return Outcome(place.partition('/')[0], place, case, record.number, way, errors,
                   found.accepted, float(found.confidence), float(nees),
                   '' if found.accepted else str(found.refusal_kind or way), found.reason,
                   found.source)


def table(outcomes: Iterable[Outcome], by: Sequence[str]) -> list[str]:
    """Return a line for each group of outcomes and way.

    Parameters
    ----------
    outcomes : iterable of Outcome
    by : sequence of str
        Fields that make a group: site, place, family, case. Without any, all make one.
    """
    groups: dict[tuple[str, ...], dict[str, list[Outcome]]] = {}
    for one in outcomes:
        key = tuple(getattr(one, name) for name in by) or ('all',)
        groups.setdefault(key, {}).setdefault(one.way, []).append(one)
    width = max([4, *(len('  '.join(key)) for key in groups)])
    lines = [f'{"case":{width}}  way        queries   .1   .25  .5   1 m  accepted  recall  '
             'in 95 %  false  of queries, 95 %  refused']
    for key, ways in groups.items():
        lines += [f'{"  ".join(key):{width}}  {way:9}  {_figures(found, 0)}  {_kinds(found)}'
                  for way, found in ways.items()]
        for way, found in ways.items():
            other = [one for one in found if len(one.errors_m) > 1]
            if other:
                lines.append(f'{"  as of the moved half":{width}}  {way:9}  {_figures(other, 1)}')
    return lines


def _figures(outcomes: Sequence[Outcome], truth: int) -> str:
    errors = np.array([one.errors_m[truth] for one in outcomes])
    accepted = np.array([one.accepted for one in outcomes])
    right = errors < WRONG_M
    nees = np.array([one.nees for one in outcomes])
    judged = accepted & np.isfinite(nees)
    shares = ' '.join(f'{np.mean(errors < limit):4.2f}' for limit in LIMITS_M)
    recall = f'{accepted[right].mean():6.2f}' if right.any() else '     -'
    inside = f'{within_ellipsoid(nees[judged]):7.2f}' if judged.any() and not truth else '      -'
    false = int((accepted & ~right).sum())
    low, high = wilson_interval(false, len(errors))
    return (f'{len(errors):7}  {shares}  {accepted.sum():8}  {recall}  {inside}  {false:5}  '
            f'{low:.3f} to {high:.3f} ')


def _kinds(outcomes: Sequence[Outcome]) -> str:
    kinds = Counter(one.refusal for one in outcomes if one.refusal)
    return ', '.join(f'{count} {kind}' for kind, count in kinds.most_common())


def as_dicts(outcomes: Iterable[Outcome]) -> list[dict[str, object]]:
    """Return outcomes for JSON; infinite numbers are None."""
    def plain(value: object) -> object:
        if isinstance(value, tuple):
            return [plain(one) for one in value]
        return None if isinstance(value, float) and not np.isfinite(value) else value
    return [{name: plain(value) for name, value in asdict(one).items()} for one in outcomes]


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the share of right poses over the confidence of each way."""
    figure, axes = new_axes('confidence', f'share of poses within {WRONG_M:g} m')
    judged: Mapping[str, list[Outcome]] = {
        way: [one for one in outcomes if one.way == way and one.confidence > 0.0]
        for way in WAYS}
    draw_reliability(axes, {way: (np.array([one.confidence for one in found]),
                                  np.array([one.errors_m[0] < WRONG_M for one in found]))
                            for way, found in judged.items() if found})
    add_legend(figure)
    save_figure(figure, path)


def make_judge() -> Callable[[Path], list[Outcome]]:
    """Return judge, for workers."""
    return judge
