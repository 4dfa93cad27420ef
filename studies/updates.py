# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Does an update find the changes? ``python -m studies.updates OBSERVATIONS.npz...``.

One part of each recording is mapped, another part updates the map. The splits come from
splits.json beside the recording, or are halves and every second image. Nothing moves in the
recordings, so the study simulates changes of landmarks that the other part shows well and that
stand apart from others of their class.

wrong map   The boxes are real. In the map, some landmarks are displaced by .3 to 1 m, some are
            missing, and some are added in places that are free and in view.
away, back  In a first update, the boxes of some landmarks are missing, and those of others are
            where the displaced objects would appear. The second update uses the original boxes.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.ellipsoid import STANDS_IN, normalized_lengths
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.association import associate, find_overlaps
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, look_for
from cliploc_ros.offline.mapping.landmarks import (
    Landmarks,
    classes_of,
    landmarks_of_map,
    project_box,
)
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update.alignment import refit
from cliploc_ros.offline.mapping.update.judging import LEAST_VIEWS
from cliploc_ros.offline.mapping.update.updating import update_map
from cliploc_ros.offline.mapping.views import Views, make_views
from studies.reports import grouped, run_all, table

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
_WAYS_M = 0.3, 1.0
# A landmark within the first distance of its place is in its place; changed landmarks are at least
# this far from others of their class. A kept landmark has moved if its centre changed by more than
# the second distance [m].
_IN_PLACE_M, _MOVED_M = 0.15, 0.05
_PLACES_TRIED = 1000


@dataclass(frozen=True, eq=False)
class Part:
    """A map of one part of a recording (L landmarks), and the other part (n boxes)."""

    recording: str
    name: str
    old: LandmarkMap
    later: PosedDetections
    views: Views  #: Views of the later part
    true: Landmarks  #: The landmarks, refitted to all images
    things: Floats  #: (m, 3): centres of the map of all images
    shown: Rows  #: (n,): the landmark that each box shows, -1 for none
    known: Rows  #: Landmarks that may be changed


@dataclass(frozen=True)
class Outcome:
    """The state of a landmark after an update."""

    recording: str
    part: str
    kind: str
    change: str  #: The simulated change
    name: str
    is_found: bool  #: A landmark of its class is in its place
    is_back: bool  #: A landmark in its place has its id
    is_ghost: bool  #: A landmark with its id is where there is no object
    way_m: float  #: Displacement of its centre, if it is in both maps [m]
    is_worse: bool  #: It is farther from its place by more than 5 cm


def run() -> int:
    """Update all maps; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m studies.updates', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('observations', nargs='+', type=Path, metavar='NPZ')
    parser.add_argument('--changes', type=positive_int, default=4, metavar='N',
                        help='changes of each kind in each map (%(default)s)')
    parser.add_argument('--draws', type=positive_int, default=3, metavar='N')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args()
    found: list[Outcome] = run_all(
        partial(_make_work, options.changes, options.draws),
        [(path, name) for path in options.observations for name in _splits(path)], 'parts',
        options.workers)
    columns: dict[str, Callable[[Outcome], bool]] = {
        'in its place': lambda outcome: outcome.is_found,
        'with its id': lambda outcome: outcome.is_back,
        'ghosts': lambda outcome: outcome.is_ghost,
        'moved by 5 cm': lambda outcome: outcome.way_m > _MOVED_M,
        'worse by 5 cm': lambda outcome: outcome.is_worse}
    for by in (['kind', 'change'], ['recording', 'part', 'kind', 'change']):
        print(table([*by, 'n', *columns], [
            (*key, len(outcomes), *(f'{np.mean(list(map(column, outcomes))):.3f}'
                               for column in columns.values()))
            for key, outcomes in grouped(found, by).items()]) + '\n')
    return 0


def _splits(path: Path) -> dict[str, tuple[Rows, Rows]]:
    """Return the frames of the map and those of the update, by the name of the split."""
    rows = np.arange(len(load_observations(path)))
    maps = {'even': rows[::2], 'half0': rows[:len(rows) // 2], 'half1': rows[len(rows) // 2:]}
    if (file := path.with_name('splits.json')).exists():
        maps = {name: np.array(entry['map']) for name, entry in json.loads(
            file.read_text()).items()}
    other = str.maketrans('01', '10')
    return {name: (own, maps.get(name.translate(other), own) if name[-1] in '01'
                   else np.setdiff1d(rows, own)) for name, own in maps.items()}


def _make_work(changes: int, draws: int) -> Callable[[tuple[Path, str]], list[Outcome]]:
    def work(task: tuple[Path, str]) -> list[Outcome]:
        part = make_part(*task)
        found = list(_judged(part, 'nothing', part.old, update_map(
            part.old, part.later).landmark_map, {}))
        for draw in range(draws):
            found += change(part, changes, np.random.default_rng(draw))
        return found
    return work


def make_part(path: Path, name: str) -> Part:
    """Build the map of one split of the observations in a file."""
    observations = load_observations(path)
    mapped, rest = _splits(path)[name]
    old = build_map(observations.select_frames(mapped)).landmark_map
    every, landmarks = make_views(observations), landmarks_of_map(old, observations.class_names)
    true = refit(every, landmarks, associate(every, landmarks),
                 MappingOptions.min_viewpoints).landmarks
    later = observations.select_frames(rest)
    views = make_views(later)
    well = associate(views, true, MIN_MEDIAN_IOU)
    return Part(path.parent.name, name, old, later, views, true,
                build_map(observations).landmark_map.centers, associate(views, true),
                np.array([row for row in range(len(old)) if _stands_apart(old, true, row)
                          and len(np.unique(views.viewpoints[views.frames[well == row]]))
                          >= LEAST_VIEWS], dtype=np.int64))


def _stands_apart(old: LandmarkMap, true: Landmarks, row: int) -> bool:
    return not any(
        other != row and set(classes_of(old, row)) & set(classes_of(old, other))
        and min(np.linalg.norm(centers[other] - centers[row])
                for centers in (old.centers, true.centers)) < _IN_PLACE_M
        for other in range(len(old)))


def change(part: Part, changes: int, rng: np.random.Generator) -> Iterator[Outcome]:
    """Simulate changes and update the map; yield the outcomes of all landmarks."""
    count = min(changes, len(part.known) // 5)
    displaced, removed, models = rng.permutation(part.known)[:3 * count].reshape(3, count)
    old, taken = part.old, part.things
    places, ghosts = np.empty((count, 3)), np.empty((count, 3))
    for number in range(count):
        row = int(displaced[number])
        places[number] = _free_place(part, row, row, taken, rng)
        ghosts[number] = _free_place(part, int(models[number]), int(rng.choice(part.known)), taken,
                                     rng)
        taken = np.concatenate([taken, places[[number]], ghosts[[number]]])
    wrong = replace(old, centers=old.centers.copy())
    wrong.centers[displaced] = places
    added = replace(old.select(models.tolist()), centers=ghosts,
                    landmark_ids=tuple(f'ghost_{number}' for number in range(count)))
    before = wrong.select(np.setdiff1d(np.arange(len(old)), removed).tolist()).with_more(added)
    yield from _judged(part, 'wrong map', before, update_map(before, part.later).landmark_map,
                       {'displaced': displaced, 'removed': removed})
    away = update_map(old, _elsewhere(part, displaced, places, removed))
    back = update_map(away.landmark_map, part.later, removed=away.removed)
    yield from _judged(part, 'away', old, away.landmark_map,
                       {'displaced': displaced, 'removed': removed},
                       dict(zip(displaced.tolist(), places, strict=True)), removed.tolist())
    yield from _judged(part, 'back', away.landmark_map, back.landmark_map,
                       {'displaced': displaced, 'removed': removed})


def _judged(part: Part, kind: str, before: LandmarkMap, after: LandmarkMap,
            changed: Mapping[str, Rows], places: Mapping[int, Floats] | None = None,
            gone: Sequence[int] = ()) -> Iterator[Outcome]:
    """Yield the outcomes of all landmarks, with objects moved to other places or gone."""
    first, last = (dict(zip(landmark_map.landmark_ids, landmark_map.centers, strict=True))
                   for landmark_map in (before, after))
    there = np.setdiff1d(np.arange(len(part.old)), gone)
    moved = {} if places is None else places
    things = np.concatenate([part.old.centers[there], part.true.centers[there], *(
        place[None] for place in moved.values()), *([] if len(gone) else [part.things])])

    def outcome(change: str, name: str, row: int = -1) -> Outcome:
        own = [part.true.centers[row], part.old.centers[row]] if row >= 0 else []
        if row in moved:
            own = [moved[row]]
        near = [number for number, center in enumerate(after.centers)
                if any(np.linalg.norm(center - place) < _IN_PLACE_M for place in own)]
        is_found = any(set(classes_of(after, number)) & set(classes_of(part.old, row))
                       for number in near)
        is_ghost = name in last and np.linalg.norm(things - last[name], axis=1).min() > _IN_PLACE_M
        way_m, is_worse = 0.0, False
        if change == 'kept' and name in last:
            way_m = float(np.linalg.norm(last[name] - first[name]))
            was_off, is_off = (np.linalg.norm(centers[name] - own[0]) for centers in (first, last))
            is_worse = bool(is_off > was_off + _MOVED_M)
        return Outcome(part.recording, part.name, kind, change, name, is_found,
                       name in {after.landmark_ids[number] for number in near}, bool(is_ghost),
                       way_m, is_worse)

    for what, rows in changed.items():
        yield from (outcome(what, part.old.landmark_ids[row], row) for row in rows)
    yield from (outcome('added', name) for name in first if name.startswith('ghost'))
    others = np.setdiff1d(np.arange(len(part.old)), [row for rows in changed.values()
                                                     for row in rows])
    yield from (outcome('kept', part.old.landmark_ids[row], row) for row in others
                if part.old.landmark_ids[row] in first)


def _free_place(part: Part, model: int, beside: int, taken: Floats, rng: np.random.Generator
                ) -> Floats:
    """Return a free place for a landmark beside another one, in view of the later part."""
    basis = part.true.bases[[model]]
    shapes = np.concatenate([part.true.bases, np.repeat(basis, len(taken), axis=0)])
    shapes = shapes @ shapes.transpose(0, 2, 1) + basis @ basis.transpose(0, 2, 1)
    others = np.concatenate([part.true.centers, taken])
    for number in range(_PLACES_TRIED):  # the distance grows with the number of failed tries
        angle, way = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*_WAYS_M) + number // 100
        place = part.true.centers[beside] + way * np.array([np.cos(angle), np.sin(angle), 0.0])
        if (normalized_lengths(others - place, shapes) < STANDS_IN).any():
            continue
        there = part.true.select(np.array([model]))._replace(centers=place[None])
        solid = np.append(np.arange(len(part.old)) != model, True)
        sight = look_for(part.views, Landmarks.joined(part.true, there),
                         np.where(part.shown == model, -1, part.shown), solid)
        if sight.expected[-1] >= LEAST_VIEWS:
            return place
    return place


def _elsewhere(part: Part, displaced: Rows, places: Floats, removed: Rows) -> PosedDetections:
    """Return the later part with some objects in other places, and some removed."""
    views, true, boxes = part.views, part.true, part.later.bboxes_xyxy.copy()
    depths = None if part.later.depths is None else part.later.depths.copy()
    near, things, _ = find_overlaps(
        views._replace(classes=np.zeros_like(views.classes)),
        true._replace(classes=np.zeros_like(true.classes)), MIN_MEDIAN_IOU)
    on_gone = np.isin(things, np.concatenate([displaced, removed]))
    kept = np.ones(len(boxes), dtype=np.bool_)
    # other boxes on a changed object are removed as well
    kept[near[on_gone & (part.shown[near] < 0)]] = False
    kept[np.isin(part.shown, removed)] = False
    here, there = np.empty(4), np.empty(4)
    for row, place in zip(displaced, places, strict=True):
        for box in np.nonzero(part.shown == row)[0]:
            frame = views.frames[box]
            pose = views.rotations[frame], views.translations[frame]
            kept[box] = project_box(*pose, true.centers[row], true.bases[row], here) and (
                project_box(*pose, place, true.bases[row], there))
            if not kept[box]:
                continue
            # the detector's error is the same at both places, relative to the size of the box
            sizes = np.tile((there[2:] - there[:2]) / (here[2:] - here[:2]), 2)
            edges = there + (views.edges[box] - here) * sizes
            bounds = views.bounds[frame]
            cut = np.clip(edges, np.tile(bounds[:2], 2), np.tile(bounds[2:], 2))
            kept[box] = (cut[2:] - cut[:2]).prod() > 0.5 * (edges[2:] - edges[:2]).prod()
            camera = part.later.camera_of(frame)
            boxes[box] = cut * ([camera.fx, camera.fy] * 2) + ([camera.cx, camera.cy] * 2)
            if depths is not None:
                depths[box] += views.rotations[frame][2] @ (place - true.centers[row])
    return replace(part.later, bboxes_xyxy=boxes, depths=depths).select_boxes(kept)


if __name__ == '__main__':
    sys.exit(run_command(run))
