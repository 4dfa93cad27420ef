# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit and judge the evidence of a laser scan and an occupancy grid, in simulated worlds.

`fit` compares the ranks of right and wrong poses of the search. `judge` compares answers without
and with a scan, if everything is right and in each family of faults. Worlds have walls around
them, people, moved boxes and glass; the laser is 0.25 m above the floor.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.scan_match import ScanMatcher
from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import RIGHT_M, invert_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Scan
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.offline.posed_query import PosedQuery
from studies.acceptance.places import VERTICAL, Simulated
from studies.acceptance.troubles import FAMILIES, add_aged_twin, exchange_landmarks, unchanged
from studies.worlds.cameras import looking
from studies.worlds.places import Objects, Place
from studies.worlds.world import objects_of
from studies.wrong_sensors import scaled_focal, wrong_mount

Floats = NDArray[np.float64]
SIDE_M, HEIGHT_M, MOST_M, NOISE_M = 0.05, 0.25, 10.0, 0.02
# Margin of the walls around the things, shares of boxes that were moved since the grid was made,
# of worlds with glass, its length [m], and mean number of people.
_WALL_M, _MOVED, _GLASS, _GLASS_M, _PEOPLE = 0.5, 0.15, 0.3, (1.0, 2.5), 1.5
_MOST_RADIUS_M = 0.4
# Poses nearer to the truth may be moved to it by the scan [m].
_FAR_M = 2.0


class Floor(NamedTuple):
    """What a laser sees: walls (w, 4) as two ends, and round things (t, 3) as centre, radius."""

    walls: Floats
    things: Floats

    def ranges(self, at: Floats, angles: Floats, rng: np.random.Generator) -> Floats:
        """Return the ranges (n,) of beams at angles (n,) of a pose (3,); infinite: no echo."""
        directions = np.stack([np.cos(at[2] + angles), np.sin(at[2] + angles)], axis=1)
        found = np.full(len(angles), np.inf)
        for x, y, u, v in self.walls:
            along = np.array([u - x, v - y])
            cross = directions[:, 0] * along[1] - directions[:, 1] * along[0]
            with np.errstate(all='ignore'):
                way = ((x - at[0]) * along[1] - (y - at[1]) * along[0]) / cross
                share = ((x - at[0]) * directions[:, 1] - (y - at[1]) * directions[:, 0]) / cross
            hit = (way > 0.0) & (share >= 0.0) & (share <= 1.0)
            found = np.where(hit, np.minimum(found, way), found)
        offsets = self.things[:, :2] - at[:2]
        ahead = directions @ offsets.T
        gap = self.things[:, 2] ** 2 - (offsets ** 2).sum(axis=1) + ahead ** 2
        with np.errstate(invalid='ignore'):
            way = np.where((gap > 0.0) & (ahead > 0.0), ahead - np.sqrt(gap), np.inf)
        found = np.minimum(found, np.where(way > 0.0, way, np.inf).min(axis=1, initial=np.inf))
        found = found + NOISE_M * rng.normal(size=len(found))
        return np.where(found < MOST_M, found, np.inf)


def floor_of(place: Place, objects: Objects, kind: str) -> Floor:
    """Return the walls and things of a place."""
    rooms = [(0.0, place.width)]
    if kind == 'two rooms':
        half = 0.5 * (place.width - 1.5)
        rooms = [(0.0, half), (half + 1.5, place.width)]
    walls, low, high = [], -_WALL_M, place.depth + _WALL_M
    for first, last in rooms:
        left, right = first - _WALL_M, last + _WALL_M
        walls += [(left, low, right, low), (right, low, right, high), (right, high, left, high),
                  (left, high, left, low)]
    reaches = np.abs(objects.centers[:, 2] - HEIGHT_M) < objects.semi_axes[:, 2]
    radii = np.minimum(objects.semi_axes[:, :2].mean(axis=1), _MOST_RADIUS_M)
    return Floor(np.array(walls), np.column_stack([objects.centers[:, :2], radii])[reaches])


def moved(floor: Floor, share: float, rng: np.random.Generator) -> Floor:
    """Return a floor with a share of its things elsewhere."""
    things = floor.things.copy()
    rows = rng.random(len(things)) < share
    low, high = floor.walls[:, :2].min(axis=0), floor.walls[:, :2].max(axis=0)
    things[rows, :2] = rng.uniform(low, high, (int(rows.sum()), 2))
    return Floor(floor.walls, things)


def half_moved(floor: Floor) -> Floor:
    """Return a floor with all walls and things of one half moved by a metre."""
    middle = 0.5 * (floor.walls[:, 0].min() + floor.walls[:, 0].max())
    walls, things = floor.walls.copy(), floor.things.copy()
    walls[:, [0, 2]] += np.where(walls[:, [0, 2]] > middle, 1.0, 0.0)
    things[things[:, 0] > middle, :2] += 0.7
    return Floor(walls, things)


def grid_of(floor: Floor, margin_m: float = 1.0) -> OccupancyGrid:
    """Return the grid of a floor: free inside the walls, unknown outside."""
    low = floor.walls[:, :2].min(axis=0) - margin_m
    size = np.ceil((floor.walls[:, :2].max(axis=0) + margin_m - low) / SIDE_M).astype(int)
    cells = np.full((size[1], size[0]), 255, np.uint8)

    def pixel(point: Floats) -> tuple[int, int]:
        x, y = ((point - low) / SIDE_M - 0.5).round().astype(int).tolist()
        return x, y
    for first in range(0, len(floor.walls), 4):
        corners = floor.walls[first:first + 4, :2]
        cv2.rectangle(cells, pixel(corners.min(axis=0)), pixel(corners.max(axis=0)), 0, -1)
    for x, y, radius in floor.things:
        cv2.circle(cells, pixel(np.array([x, y])), round(radius / SIDE_M), 100, -1)
    for x, y, u, v in floor.walls:
        cv2.line(cells, pixel(np.array([x, y])), pixel(np.array([u, v])), 100)
    pose = np.eye(4)
    pose[:2, 3] = low
    return OccupancyGrid(cells.view(np.int8), SIDE_M, pose, 'map')


class Seen(NamedTuple):
    """What was mapped and what is true where a robot looks."""

    mapped: Floor
    floor: Floor
    other: OccupancyGrid  #: Of another floor
    fov_deg: float


def spot_of(pose: Floats) -> Floats:
    """Return x, y and yaw (3,) of the laser below a camera at a pose (4, 4)."""
    return np.array([*pose[:2, 3], np.arctan2(pose[1, 2], pose[0, 2])])


def scan_of(seen: Seen, pose: Floats, rng: np.random.Generator, spot: Floats | None = None,
            turn: float = 0.0, side: float = 1.0) -> Scan:
    """Return the scan of a laser below a camera at a pose (4, 4), or at another spot (3,)."""
    angles = np.radians(np.linspace(-seen.fov_deg / 2.0, seen.fov_deg / 2.0,
                                    int(seen.fov_deg) + 1))
    at = spot_of(pose) if spot is None else spot
    people = np.column_stack([at[:2] + rng.uniform(-3.0, 3.0, (rng.poisson(_PEOPLE), 2)),
                              ]).reshape(-1, 2)
    people = people[np.linalg.norm(people - at[:2], axis=1) > 0.4]
    floor = Floor(seen.floor.walls, np.concatenate([
        seen.floor.things, np.column_stack([people, np.full(len(people), 0.2)])]))
    ranges = floor.ranges(at, side * angles, rng)
    if rng.random() < _GLASS:
        middle = rng.uniform(angles[0], angles[-1])
        away = ranges[np.argmin(np.abs(angles - middle))]
        half = 0.5 * rng.uniform(*_GLASS_M) / min(away, 5.0)
        ranges[np.abs(angles - middle) < half] = np.inf
    laser = looking(np.array([*spot_of(pose)[:2], HEIGHT_M]), spot_of(pose)[2] + turn, 0.0)
    body = laser @ np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0],
                             [0.0, 0.0, 0.0, 1.0]])
    return Scan(angles, ranges, MOST_M, invert_transform(pose) @ body)


def elsewhere(seen: Seen, pose: Floats, rng: np.random.Generator) -> Floats:
    """Draw a free spot (3,) far from a pose, if there is one."""
    poses = grid_of(seen.floor).field
    low = seen.floor.walls[:, :2].min(axis=0) - 1.0 - poses.margin_m
    spots = poses.poses + np.append(low, 0.0)
    far = np.linalg.norm(spots[:, :2] - pose[:2, 3], axis=1) > 2.0
    return np.asarray(spots[rng.choice(np.nonzero(far)[0] if far.any() else len(spots))])


def late(seen: Seen, pose: Floats, rng: np.random.Generator) -> Floats:
    """Return the spot (3,) of a scan that is .3 s older than the image."""
    step = rng.uniform(-1.0, 1.0, 3) * [0.15, 0.15, 0.3]
    return np.asarray(spot_of(pose) + step)


#: Scans by family: a function of what is seen, the pose and a random generator
SCANS: dict[str, Callable[[Seen, Floats, np.random.Generator], Scan]] = {
    'scan of another place': lambda seen, pose, rng: scan_of(seen, pose, rng, elsewhere(
        seen, pose, rng)),
    'scan late by .3 s': lambda seen, pose, rng: scan_of(seen, pose, rng, late(seen, pose, rng)),
    'scan mirrored': lambda seen, pose, rng: scan_of(seen, pose, rng, side=-1.0),
    'laser turned by 20 degrees': lambda seen, pose, rng: scan_of(seen, pose, rng,
                                                                  turn=np.radians(20.0))}
#: Grids by family
GRIDS: dict[str, Callable[[Seen], OccupancyGrid]] = {
    'grid of another floor': lambda seen: seen.other,
    'half of the grid moved': lambda seen: grid_of(half_moved(seen.mapped)),
    'all boxes moved': lambda seen: grid_of(moved(seen.mapped, 1.0, np.random.default_rng(0)))}
#: Maps and queries by family
FAULTS: dict[str, Callable[..., tuple[LandmarkMap, Sequence[PosedQuery]]]] = {
    'nothing wrong': unchanged,
    'another place': lambda found, queries, level, rng: exchange_landmarks(
        found, queries, 1.0, rng),
    'half of the map moved by .7 m': lambda found, queries, level, rng: FAMILIES[
        'C half of the map moved by [m]'].change(found, queries, 0.7, rng),
    'aged twin': lambda found, queries, level, rng: add_aged_twin(found, queries, 0.5, rng),
    'K x .5': lambda found, queries, level, rng: (found, scaled_focal(queries, 0.5)),
    'K x 2': lambda found, queries, level, rng: (found, scaled_focal(queries, 2.0)),
    'camera turned by 10 degrees': lambda found, queries, level, rng: (
        found, wrong_mount(queries, 10.0))}


def answers(kind: str, seed: int, mode: str, fovs: Sequence[float], families: Sequence[str]
            ) -> Iterator[dict[str, Any]]:
    """Yield the answers to the queries of a world, in some families, without and with a scan."""
    world = Simulated(kind, seed).load()
    place, objects = objects_of(kind, seed)
    rng = np.random.default_rng([seed, 57])
    mapped = floor_of(place, objects, kind)
    other = grid_of(floor_of(*objects_of(kind, seed + 1000), kind))
    options = world.options(mode, RelocalizerOptions())
    for fault in [name for name in families if name in FAULTS]:
        change = FAULTS[fault]
        found, queries = change(world.landmark_map, world.ask(mode, seed), 0.0,
                                np.random.default_rng(seed))
        relocalizer = Relocalizer(found, replace(options, k=min(options.k, len(found))))
        # an equal room beside this one is on the grid, too
        its = doubled(mapped, world.landmark_map, 2.0) if fault == 'aged twin' else mapped
        floor, grid = moved(its, _MOVED, rng), grid_of(its)
        for query in queries:
            about = {'kind': kind, 'seed': seed, 'number': query.number, 'mode': mode}
            case = Case(relocalizer, relocalizer.search(query.observation), query,
                        fault == 'another place')
            yield about | case.answer(fault, 0.0)
            for fov in fovs if fault in ('nothing wrong', 'aged twin') else fovs[:1]:
                seen = Seen(its, floor, other, fov)
                scan = scan_of(seen, query.map_from_camera, rng)
                yield about | case.answer(fault, fov, scan, grid)
                if fault != 'nothing wrong' or fov != fovs[0] or 'scans' not in families:
                    continue
                for family, draw in SCANS.items():
                    yield about | case.answer(family, fov, draw(
                        seen, query.map_from_camera, rng), grid)
                for family, make in GRIDS.items():
                    yield about | case.answer(family, fov, scan, make(seen))


class Case(NamedTuple):
    """A searched image of a place."""

    relocalizer: Relocalizer
    searched: SearchedFrame
    query: PosedQuery
    is_elsewhere: bool  #: Whether every pose is wrong

    def answer(self, family: str, fov: float, scan: Scan | None = None,
               grid: OccupancyGrid | None = None) -> dict[str, Any]:
        """Return the fields of the answer with a scan."""
        result = self.relocalizer.locate([self.searched._replace(observation=replace(
            self.searched.observation, scan=scan))], grid=grid)
        fits = []
        if scan is not None and grid is not None:
            matcher = ScanMatcher(scan, grid, self.relocalizer.landmark_map)
            plain = self.relocalizer.locate([self.searched])
            fits = [(found.rank, self.error_m(hypothesis.map_from_camera), found.explained)
                    for hypothesis in plain.hypotheses
                    if (found := matcher.fits(hypothesis.map_from_camera))]
        evidence = result.evidence
        return {'family': family, 'fov': fov, 'accepted': result.accepted,
                'error_m': self.error_m(result.map_from_camera), 'fits': fits,
                'confidence': result.confidence, 'reason': str(result.refusal_kind or ''),
                'scan': str(evidence.scan) if evidence and evidence.scan else ''}

    def error_m(self, pose: Floats | None) -> float:
        """Return the distance of a pose (4, 4) from the truth [m]; infinite without one."""
        if pose is None or self.is_elsewhere:
            return float('inf')
        return pose_error(pose, self.query.map_from_camera)[0]


def doubled(floor: Floor, landmark_map: LandmarkMap, gap_m: float) -> Floor:
    """Return a floor with a copy beside it, as add_equal_room does."""
    step = float(np.ptp(landmark_map.centers[:, 0])) + gap_m
    # walls between the rooms that the copy would cut are left out
    return Floor(np.concatenate([floor.walls, floor.walls + np.array([step, 0.0, step, 0.0])]),
                 np.concatenate([floor.things, floor.things + np.array([step, 0.0, 0.0])]))


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print the table of answers, by family and field of view."""
    print(f'{"family":32} {"fov":>4} {"n":>5} {"right":>6} {"accepted":>8} {"false":>6} '
          f'{"refused right":>13} {"median [m]":>10}')
    for family in dict.fromkeys(row['family'] for row in rows):
        for fov in sorted({row['fov'] for row in rows if row['family'] == family}):
            some = [row for row in rows if (row['family'], row['fov']) == (family, fov)]
            right = [row for row in some if row['error_m'] < RIGHT_M]
            accepted = [row for row in some if row['accepted']]
            false = sum(row['error_m'] >= RIGHT_M for row in accepted)
            errors = [row['error_m'] for row in accepted] or [np.nan]
            print(f'{family:32} {fov:4.0f} {len(some):5} {len(right):6} {len(accepted):8} '
                  f'{false:6} {sum(not row["accepted"] for row in right):13} '
                  f'{np.median(errors):10.3f}')


def fit(rows: Sequence[dict[str, Any]], wrong_scans: float = 0.05) -> None:
    """Print the log odds of each range of ranks: how often right and wrong poses have them."""
    edges = np.array([0, 1, 4, 20, 100, 249, np.inf])
    every = [(*found, row['family']) for row in rows for found in row['fits']]
    counts = np.array([np.histogram([found[0] for found in every if is_chosen(found)],
                                    edges + 0.5)[0] for is_chosen in (
        lambda found: found[1] < RIGHT_M and found[3] not in (*SCANS, *GRIDS),
        lambda found: found[1] < RIGHT_M and found[3] in SCANS,
        lambda found: found[1] > _FAR_M and found[3] not in (*SCANS, *GRIDS))])
    right, late, chance = (counts + 0.5) / (counts.sum(axis=1, keepdims=True) + 3.0)
    odds = np.log(((1.0 - wrong_scans) * right + wrong_scans * late) / chance)
    print(f'ranks up to {edges[1:]}: right poses, right poses with a wrong scan, wrong poses:\n'
          f'{counts}\n{np.array([right, late, chance]).round(3)}\n  log odds {odds.round(2)}')


def main() -> None:
    """Simulate, or read stored answers; print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('do', choices=('simulate', 'judge', 'fit'))
    parser.add_argument('--answers', type=Path, default=Path('scan.jsonl'))
    parser.add_argument('--kinds', nargs='+', default=['room', 'office', 'shop', 'two rooms',
                                                       'hall'])
    parser.add_argument('--worlds', type=int, default=10)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--mode', default=VERTICAL)
    parser.add_argument('--fov', type=float, nargs='+', default=[270.0, 60.0])
    parser.add_argument('--families', nargs='+', default=[*FAULTS, 'scans'])
    parser.add_argument('--terms', type=json.loads, default={})
    options = parser.parse_args()
    CALIBRATION.scan.update(options.terms)
    if options.do == 'simulate':
        with options.answers.open('a') as file:
            for seed in range(options.first, options.first + options.worlds):
                for kind in options.kinds:
                    for row in answers(kind, seed, options.mode, options.fov, options.families):
                        file.write(json.dumps(row) + '\n')
                    file.flush()
    rows = [json.loads(line) for line in options.answers.read_text().splitlines()]
    (fit if options.do == 'fit' else report)(rows)


if __name__ == '__main__':
    main()
