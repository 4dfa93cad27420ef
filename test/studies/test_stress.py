# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The stress list: sensors go wrong as said, and the table counts every request."""

from itertools import pairwise

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation import sensors
from studies.acceptance import places, stress

KIND, SEED = 'room', 1000


@pytest.fixture(scope='module')
def place():
    return places.Simulated(KIND, SEED)()


@pytest.fixture(scope='module')
def queries(place):
    """Queries with true verticals and odometry."""
    return sensors.with_neighbours(sensors.with_vertical(place.frames), place.groups)


def angle_deg(one, other):
    return np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0)))


def steps(query):
    frames = sorted((*query.neighbours, query.observation), key=lambda one: one.stamp_ns)
    poses = [one.odom_from_camera for one in frames]
    return [invert_transform(a) @ b for a, b in pairwise(poses)]


def test_verticals_are_tilted_by_an_angle(queries):
    for before, after in zip(queries, sensors.tilted_vertical(queries, 10.0), strict=True):
        up = before.map_from_camera[2, :3]
        assert angle_deg(after.observation.up_in_camera, up) == pytest.approx(10.0)


def test_a_wrong_mount_turns_verticals_and_steps_alike(queries):
    before, after = queries[4], sensors.wrong_mount(queries, 5.0)[4]
    up, wrong_up = before.observation.up_in_camera, after.observation.up_in_camera
    assert 0.0 < angle_deg(up, wrong_up) <= 5.0 + 1e-6
    mount = invert_transform(before.observation.odom_from_camera) @ \
        after.observation.odom_from_camera
    assert pose_error(mount, np.eye(4))[1] == pytest.approx(5.0)
    np.testing.assert_allclose(mount[:3, :3].T @ up, wrong_up)
    for own, wrong in zip(steps(before), steps(after), strict=True):
        np.testing.assert_allclose(mount @ wrong, own @ mount, atol=1e-12)


def test_odometry_is_scaled(queries):
    before, after = queries[4], sensors.scaled_odometry(queries, 1.2)[4]
    assert len(steps(before)) == 4
    for own, long in zip(steps(before), steps(after), strict=True):
        own_m, own_deg = pose_error(np.eye(4), own)
        assert pose_error(np.eye(4), long) == pytest.approx((1.2 * own_m, 1.2 * own_deg))


def test_the_table_counts_each_request_once(capsys):
    assert stress.run(['--worlds', '1', '--kinds', KIND, '--only', 'two identical']) == 0
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == 3, 'one for each mode'
    for row in rows:
        _, _, requests, right, accepted, false, _, _ = row.strip('|').split('|')
        assert int(requests) == 4
        assert 0 <= int(false) <= int(accepted) <= 4
        assert 0.0 <= float(right) <= 1.0


def test_nothing_wrong_is_mostly_right(place):
    fused = [one for one in stress.try_place(place, stress.TROUBLES[0], 'hybrid')
             if one.mode == places.ALL]
    assert fused[0].right >= 3
    assert fused[0].false == 0


@pytest.mark.parametrize('words', [[], ['--worlds', '1', '--only', 'no such trouble'],
                                   ['--queries', 'a.npz', 'b.npz'], ['--worlds', '-1']])
def test_nothing_to_test_is_refused(words):
    with pytest.raises(OptionsError):
        stress.run(words)
