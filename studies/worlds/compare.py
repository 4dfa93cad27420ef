# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated worlds next to recordings: ``python -m studies.worlds.compare --help``.

The same figures of both show whether the simulation is like the recordings. A box shows the
landmark whose outline overlaps it most at the true pose, by an IoU above 0.3.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.datasets.queries import load_queries
from cliploc_ros.offline.evaluation.trials import PosedQuery, make_queries
from studies.worlds.places import KINDS
from studies.worlds.world import make_world

_SHOWN_IOU, _SHOWN_SHARE, _LEAST_SIDE_PX = 0.3, 0.6, 12.0


class Look(NamedTuple):
    """How detections and map agree in one image: n boxes, of which m show a landmark."""

    #: Boxes, landmarks in view (walls and other objects hide some), and those of them shown
    boxes: int
    in_view: int
    found: int
    sides_px: NDArray[np.float64]  #: (n,): mean side of each box [px]
    ious: NDArray[np.float64]  #: (m,): of box and landmark
    #: (m, 4): as shares of the landmark's sides; NaN at the image border
    edge_errors: NDArray[np.float64]
    same_class: NDArray[np.bool_]  #: (m,)
    ranks: NDArray[np.int64]  #: (m,): number of labels more similar than the landmark's


def look(landmark_map: LandmarkMap, query: PosedQuery) -> Look:
    """Compare the detections of an image with the map at the true pose."""
    observation = query.observation
    camera, boxes = observation.camera, observation.detections.bboxes_xyxy
    outlines = project_ellipsoids(invert_transform(query.map_from_camera), landmark_map.centers,
                                  landmark_map.shapes)
    full = ellipse_bboxes(ellipses_in_pixels(outlines, camera))
    clipped = np.clip(full, 0.0, [camera.width, camera.height] * 2)
    with np.errstate(invalid='ignore'):
        sides, shown_sides = full[:, 2:] - full[:, :2], clipped[:, 2:] - clipped[:, :2]
        in_view = (shown_sides >= _LEAST_SIDE_PX).all(axis=1)
        in_view &= shown_sides.prod(axis=1) > _SHOWN_SHARE * sides.prod(axis=1)
    ious = np.nan_to_num(box_ious(boxes, clipped))
    if not ious.size:
        none = np.empty(0)
        return Look(len(boxes), int(in_view.sum()), 0, none, none, none.reshape(0, 4),
                    none.astype(bool), none.astype(np.int64))
    shown = np.argmax(ious, axis=1)
    rows = np.nonzero(ious.max(axis=1) > _SHOWN_IOU)[0]
    of = shown[rows]
    errors = (boxes[rows] - clipped[of]) / np.tile(shown_sides[of], 2)
    is_cut = (boxes[rows] < 2.0) | (boxes[rows] > [camera.width - 2, camera.height - 2] * 2)
    errors[is_cut] = np.nan
    classes = np.array(observation.detections.class_ids, dtype=object)
    similarities = np.asarray(observation.similarities)[rows]
    ranks = (similarities > similarities[np.arange(len(rows)), of][:, None]).sum(axis=1)
    return Look(len(boxes), int(in_view.sum()), len(np.intersect1d(of, np.nonzero(in_view)[0])),
                np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)), ious[rows, of], errors,
                classes[rows] == np.array(landmark_map.class_ids, dtype=object)[of], ranks)


def box_ious(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU (n, m) of boxes (n, 4) and (m, 4)."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return np.asarray(shared / (areas[0][:, None] + areas[1] - shared))


def describe(looks: Sequence[Look]) -> str:
    """Return the figures of some images in one line."""
    ious = np.concatenate([one.ious for one in looks])
    errors = np.abs(np.concatenate([one.edge_errors for one in looks]))
    same = np.concatenate([one.same_class for one in looks])
    ranks = np.concatenate([one.ranks for one in looks])
    boxes = np.array([one.boxes for one in looks])
    sides = np.median(np.concatenate([one.sides_px for one in looks]))
    explained = len(ious) / max(boxes.sum(), 1)
    seen = sum(one.found for one in looks) / max(sum(one.in_view for one in looks), 1)
    return (f'{boxes.mean():5.1f} boxes ({np.quantile(boxes, 0.1):.0f} to '
            f'{np.quantile(boxes, 0.9):.0f}) of {sides:.0f} px, {explained:.2f} explained, '
            f'{seen:.2f} of those in view found, box IoU {np.median(ious):.2f} '
            f'({np.quantile(ious, 0.1):.2f}), edges off {np.nanmedian(errors):.3f} '
            f'({np.nanquantile(errors, 0.9):.2f}), same class {same.mean():.2f}, '
            f'top-1 {(ranks < 1).mean():.2f}, top-3 {(ranks < 3).mean():.2f}')


def run(arguments: list[str]) -> int:
    """Print the figures of recordings and of worlds."""
    parser = argparse.ArgumentParser(prog='compare', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, default=[], nargs='*', metavar='NPZ')
    parser.add_argument('--map', type=Path, default=[], nargs='*', metavar='YAML',
                        help='of each query file')
    parser.add_argument('--worlds', type=positive_int, default=20, metavar='N',
                        help='of each kind')
    options = parser.parse_args(arguments)
    if len(options.queries) != len(options.map):
        raise OptionsError('give as many maps as query files, in the same order')
    for path, map_path in zip(options.queries, options.map, strict=True):
        landmark_map = LandmarkMap.from_file(map_path)
        queries = make_queries(load_queries(path, landmark_map.landmark_ids), landmark_map, True)
        print(f'{path.stem:12} {describe([look(landmark_map, one) for one in queries])}')
    for kind in KINDS:
        worlds = [make_world(kind, seed) for seed in range(options.worlds)]
        print(f'{kind:12} '
              f'{describe([look(one.landmark_map, q) for one in worlds for q in one.queries])}')
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
