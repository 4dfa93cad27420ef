# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge the evidence of a scan with real depth: a grid from one half of a recording, 60 degrees.

A slice of the depth images around the height of the camera stands for a laser, so that scan and
grid are of different images. Objects are mapped from the same half as the grid.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import OPTICAL_FROM_BODY, Scan
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.frames import RawFrame
from cliploc_ros.offline.mapping.building import build_map
from studies.rooms.rooms import Room, RoomOptions, read_room
from studies.scan import Case, fit, report
from studies.worlds.cameras import looking
from studies.wrong_sensors import scaled_focal

Floats = NDArray[np.float64]
_SIDE_M, _MOST_M, _SLICE_M, _BELOW_M, _BEAM = 0.05, 6.0, 0.15, 0.5, np.radians(0.5)
_LEAST_HITS = 2


def slice_of(raw: RawFrame, its_pose: Floats, height_m: float) -> Floats:
    """Return the nearest point (n, 2) of each beam of a slice of a depth image, in the map."""
    assert raw.depth is not None
    depth, (_, camera) = raw.depth(), raw.color()
    its = depth.camera or camera
    rows, columns = np.mgrid[0:depth.depths_m.shape[0]:2, 0:depth.depths_m.shape[1]:2]
    z = depth.depths_m[::2, ::2].astype(float)
    points = np.stack([(columns - its.cx) / its.fx * z, (rows - its.cy) / its.fy * z, z], axis=-1)
    points = points[np.isfinite(z)]
    pose = its_pose
    if depth.camera is not None:
        pose = pose @ depth.camera.color_from_depth
    points = points @ pose[:3, :3].T + pose[:3, 3]
    points = points[np.abs(points[:, 2] - height_m) < _SLICE_M, :2]
    offsets = points - its_pose[:2, 3]
    ways = np.linalg.norm(offsets, axis=1)
    kept = (ways > 0.2) & (ways < _MOST_M)
    points, ways = points[kept], ways[kept]
    beams = np.floor(np.arctan2(*offsets[kept].T[::-1]) / _BEAM).astype(int)
    order = np.lexsort([ways, beams])
    return points[order][np.unique(beams[order], return_index=True)[1]]


def grid_of(poses: Floats, slices: list[Floats]) -> OccupancyGrid:
    """Return the grid of slices: cells that beams end in, and cells that they pass."""
    every = np.concatenate([*slices, poses[:, :2, 3]])
    low = every.min(axis=0) - 1.0
    width, height = np.ceil((every.max(axis=0) + 1.0 - low) / _SIDE_M).astype(int)
    hits, passed = np.zeros((height, width), int), np.zeros((height, width), int)
    for start, points in zip(poses[:, :2, 3], slices, strict=True):
        for point in points:
            count = int(np.linalg.norm(point - start) / _SIDE_M)
            line = np.linspace(start, point, max(2, count), endpoint=False)[:-2]
            columns, rows = ((line - low) / _SIDE_M).astype(int).T
            passed[rows, columns] += 1
        columns, rows = ((points - low) / _SIDE_M).astype(int).T
        np.add.at(hits, (rows, columns), 1)
    cells = np.full((height, width), -1, np.int8)
    cells[passed > 0] = 0
    cells[(hits >= _LEAST_HITS) & (hits > 0.2 * passed)] = 100
    pose = np.eye(4)
    pose[:2, 3] = low
    return OccupancyGrid(cells, _SIDE_M, pose, 'map')


def scan_of(pose: Floats, points: Floats, side: float = 1.0) -> Scan:
    """Return the slice of an image as the scan of a laser at its camera."""
    yaw = np.arctan2(pose[1, 2], pose[0, 2])
    offsets = points - pose[:2, 3]
    angles = np.arctan2(offsets[:, 1], offsets[:, 0]) - yaw
    order = np.argsort((angles + np.pi) % (2.0 * np.pi))
    laser = looking(pose[:3, 3], yaw, 0.0) @ OPTICAL_FROM_BODY
    return Scan(side * angles[order], np.linalg.norm(offsets, axis=1)[order], _MOST_M,
                invert_transform(pose) @ laser)


def answers(room: Room, kinds: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the answers to the images of a room, in the form of studies.scan."""
    poses = room.detections.map_from_camera.copy()
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()  # rounded in files
    height = float(np.median(poses[:, 2, 3])) - _BELOW_M
    slices = [slice_of(raw, pose, height) for raw, pose in zip(room.raws, poses, strict=True)]
    print(room.name, 'beams of an image:', np.quantile([*map(len, slices)], [0.1, 0.5, 0.9]))
    for kind, part, mapped, asked in room.parts():
        if kind not in kinds:
            continue
        landmark_map: LandmarkMap = build_map(room.detections.select_frames(mapped)).landmark_map
        grid = grid_of(poses[mapped], [slices[row] for row in mapped])
        grid = replace(grid, frame_id=landmark_map.frame_id)
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(matching='class'))
        rng = np.random.default_rng(0)
        for row in asked:
            query = room.queries[row]
            query = replace(query, observation=replace(query.observation, depths=None))
            truth = poses[row]
            other = int(rng.choice(asked))
            away = pose_error(poses[other], truth)
            scans = {'nothing wrong': scan_of(truth, slices[row]),
                     'scan mirrored': scan_of(truth, slices[row], -1.0)}
            if away[0] > 1.5 or away[1] > 60.0:
                scans['scan of another place'] = replace(
                    scan_of(poses[other], slices[other]),
                    camera_from_laser=scans['nothing wrong'].camera_from_laser)
            found = {'nothing wrong': relocalizer.search(query.observation)}
            for factor in (0.5, 2.0):
                changed, = scaled_focal([query], factor)
                found[f'K x {factor:g}'] = relocalizer.search(changed.observation)
            for family in (*scans, 'K x 0.5', 'K x 2'):
                searched = found.get(family, found['nothing wrong'])
                scan = scans.get(family, scans['nothing wrong'])
                for fov in (0.0, 60.0) if not family.startswith('scan') else (60.0,):
                    case = Case(relocalizer, searched, query, False)
                    yield {'kind': f'{room.name} {part}', 'number': int(row)} | (
                        case.answer(family, fov, scan, grid) if fov else case.answer(family, fov))


def main() -> None:
    """Localize, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folders', nargs='+')
    parser.add_argument('--model', required=True)
    parser.add_argument('--out', type=Path, default=Path('rooms'))
    parser.add_argument('--kinds', nargs='+', default=['in turn', 'halves'])
    parser.add_argument('--answers', type=Path, default=Path('scan_depth.jsonl'))
    parser.add_argument('--terms', type=json.loads, default={})
    options = parser.parse_args()
    CALIBRATION.scan.update(options.terms)
    rows = []
    with options.answers.open('w') as file:
        for folder in options.folders:
            for row in answers(read_room(folder, RoomOptions(options.model, options.out)),
                               options.kinds):
                file.write(json.dumps(row) + '\n')
                file.flush()
                rows.append(row)
    report(rows)
    fit(rows)


if __name__ == '__main__':
    main()
