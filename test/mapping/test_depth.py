# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps built with measured depth: simulated walks, and the real kitchen."""

from dataclasses import replace

import numpy as np
import pytest
from walk import make_table, nearest_errors, see, walk_around

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.building import build_map


def measure_depth(detections, table, scale=1.0, holes=0.0, seed=0):
    """Add the depth of the surface of the ellipsoid that each box shows, with errors."""
    rng = np.random.default_rng(seed)
    depths = np.full(len(detections.classes), np.nan, dtype=np.float32)
    for row, frame in enumerate(detections.frames):
        camera_from_map = invert_transform(detections.map_from_camera[frame])
        centers = table.centers @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        pixels = centers[:, :2] / centers[:, 2:] * 500.0 + [320.0, 240.0]
        box = detections.bboxes_xyxy[row]
        nearest = np.linalg.norm(pixels - 0.5 * (box[:2] + box[2:]), axis=1).argmin()
        if rng.random() >= holes:
            surface = centers[nearest, 2] - 0.8 * table.semi_axes[nearest].min()
            depths[row] = scale * surface * rng.normal(1.0, 0.02)
    return replace(detections, depths=depths, depth_spreads=np.full_like(depths, 0.02))


def test_depth_replaces_parallax():
    table, poses = make_table(), walk_around(frames=12, turn_deg=12.0)
    boxes = see(table, poses, noise_px=1.0)
    with pytest.raises(MappingError, match='good enough'):
        build_map(boxes)
    built = build_map(measure_depth(boxes, table, holes=0.2)).landmark_map
    errors = nearest_errors(built, table)
    assert np.sum(errors < 0.12) >= 7
    assert np.median(errors) < 0.06


def test_with_parallax_boxes_decide_and_an_error_of_scale_is_corrected():
    table = make_table()
    boxes = see(table, walk_around(), noise_px=1.0)
    built = build_map(measure_depth(boxes, table, scale=1.15))
    note, = (note for note in built.report.notes if 'depth' in note)
    assert ' is 1.1' in note and 'corrected' in note
    assert len(built.landmark_map) == len(table)
    assert nearest_errors(built.landmark_map, table).max() < 0.01


@pytest.mark.parametrize(('scale', 'factor'), [(5.0, '5'), (0.2, '0.2')])
def test_depth_in_another_unit_is_refused(scale, factor):
    table = make_table()
    boxes = see(table, walk_around(frames=30))
    with pytest.raises(MappingError, match=rf'depth is {factor}.* `depth_unit`'):
        build_map(measure_depth(boxes, table, scale=scale))


def test_boxes_without_any_depth_map_as_without():
    table = make_table()
    boxes = see(table, walk_around())
    none = np.full(len(boxes.classes), np.nan, dtype=np.float32)
    built = build_map(replace(boxes, depths=none, depth_spreads=none))
    assert nearest_errors(built.landmark_map, table).max() < 0.003
