# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How long recordings are cut into pieces."""

from dataclasses import replace

import numpy as np
import pytest
from walk import make_table, nearest_errors, see, walk_around

from cliploc_ros.mapping.building import _windows, build_map
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.views import make_views, number_viewpoints, thin_out


@pytest.mark.parametrize(('stamps_s', 'expected'), [
    ([0.0, 1.0, 2.0], [(0, 3)]),
    (np.arange(0.0, 200.0), [(0, 90), (60, 150), (120, 200)]),
    ([0.0, 1.0, 500.0, 501.0], [(0, 2), (2, 4)]),
    ([0.0, 89.0, 90.0], [(0, 2), (1, 3)]),
    ([7.0, 7.0, 7.0], [(0, 3)]),
])
def test_windows_cover_every_frame(stamps_s, expected):
    assert _windows(np.array(stamps_s)) == expected


def test_a_window_holds_the_frames_of_its_time():
    views = make_views(see(make_table(), walk_around(30)), MappingOptions())
    part = views.between(10, 20)
    assert len(part.rotations) == len(part.stamps_s) == 10
    assert (part.rotations[0] == views.rotations[10]).all()
    assert (part.offsets[0], part.offsets[-1]) == (0, len(part.frames))
    assert (part.frames.min(), part.frames.max()) == (0, 9)
    assert (part.edges == views.edges[views.offsets[10]:views.offsets[20]]).all()


def test_a_camera_that_stands_still_gives_few_frames():
    poses = np.repeat(walk_around(5, turn_deg=90.0), [40, 1, 3, 2, 1], axis=0)
    assert number_viewpoints(poses).tolist() == np.repeat(range(5), [40, 1, 3, 2, 1]).tolist()
    views = make_views(see(make_table(), poses), MappingOptions())
    kept = thin_out(views, 3)
    assert np.bincount(views.viewpoints[kept]).tolist() == [3, 1, 3, 2, 1]
    assert views.weights[0] == pytest.approx(1 / 40)


def test_a_long_recording_gives_one_landmark_for_each_object():
    table = make_table()
    detections = see(table, walk_around(frames=240, turn_deg=1100.0), noise_px=2.0, missed=0.3)
    slow = replace(detections, stamps_s=2.0 * np.arange(240))
    assert len(_windows(slow.stamps_s)) == 8
    built = build_map(slow)
    assert len(built.landmark_map) == len(table)
    assert nearest_errors(built.landmark_map, table).max() < 0.01
