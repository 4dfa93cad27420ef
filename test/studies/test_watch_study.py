# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of the watch: simulated localizers, and what the watch says of them."""

from itertools import pairwise

import numpy as np
import pytest

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from studies.watch import fit
from studies.watch.judge import KIDNAPPED, alarm_table, judge, right_table
from studies.watch.localizers import (
    displaced,
    drifting,
    kidnapped,
    simulated_drive,
    turned_camera,
)
from studies.watch.sensors import measure_cost
from studies.worlds.world import make_drive

pytestmark = pytest.mark.full


def test_drives_are_reproducible_and_change_a_share_of_the_objects():
    drive, again = make_drive('office', 3, 40, 0.4), make_drive('office', 3, 40, 0.4)
    for one, other in zip(drive.world.queries, again.world.queries, strict=True):
        assert np.array_equal(one.map_from_camera, other.map_from_camera)
        assert np.array_equal(one.observation.detections.bboxes_xyxy,
                              other.observation.detections.bboxes_xyxy)
    assert 0.25 < drive.changed.mean() < 0.55
    assert drive.wrong[drive.changed].mean() > 0.9  # a moved object may end up near its place
    assert not make_drive('office', 3, 2).changed.any()
    poses = [one.map_from_camera for one in drive.world.queries]
    steps = np.array([pose_error(after, before)
                      for before, after in pairwise(poses)])
    assert steps[:, 0].max() < 0.6
    assert steps[:, 1].max() < 35.0


def test_a_localizer_drifts_and_its_odometry_fits():
    drive = simulated_drive('room', 2, 100)
    poses = drifting(drive.poses, np.random.default_rng(0), 0.2)
    errors = np.array([pose_error(*pair) for pair in zip(poses, drive.poses, strict=True)])
    assert 0.1 < errors[:, 0].mean() < 0.3
    assert errors[:, 0].max() <= 0.3 + 1e-9
    odom = np.array([one.odom_from_camera for one in drive.observations])
    for first in (0, 50, 98):
        step, true = (pair[0] @ pair[1] for pair in (
            (invert_transform(odom[first]), odom[first + 1]),
            (invert_transform(drive.poses[first]), drive.poses[first + 1])))
        assert pose_error(step, true)[0] < 0.06


def test_displacements_have_their_size():
    pose, rng = displaced(np.eye(4), 2.0, 2.0, 0.3), np.random.default_rng(1)
    bounds = np.array([[0.0, 0.0], [4.0, 4.0]])
    away = kidnapped(pose, 2.0, 0.0, bounds, rng) @ pose
    assert pose_error(away, pose) == pytest.approx((2.0, 0.0), abs=1e-6)
    assert ((away[:2, 3] > -0.2) & (away[:2, 3] < 4.2)).all()
    assert pose_error(kidnapped(pose, 0.0, 90.0, bounds, rng) @ pose, pose) == pytest.approx(
        (0.0, 90.0), abs=1e-6)
    assert pose_error(turned_camera(5.0, rng), np.eye(4)) == pytest.approx((0.0, 5.0), abs=1e-6)


def test_wrong_poses_are_noticed_and_right_ones_are_not_lost():
    right, alarms = judge(simulated_drive('room', 1000, 80), 0, wrong_poses=True)
    assert 'lost' not in right.states
    assert {'2 m', '30 deg', KIDNAPPED} <= {one.case for one in alarms}
    jumps = [one.lost for one in alarms if one.case not in ('1 m', KIDNAPPED)]
    assert np.mean(jumps) > 0.9
    assert '| room |' in right_table([right])
    assert '| all |' in alarm_table(alarms)


def test_the_fit_tells_right_from_wrong(record_property):
    looks = [one for kind in ('room', 'office') for one in fit.looks_of(kind, 1)]
    fitted = fit.fit(looks)
    record_property('figures', fit.report(looks, fitted))
    assert fitted.watch.utility > 0.0 > fitted.watch.unexplained
    assert fitted.watch.lost == CALIBRATION.watch.lost  # chosen, not fitted
    assert fit.report(looks, fitted).count('\n') == 4


def test_the_cost_of_a_look(record_property):
    found = measure_cost(100)
    record_property('figures', found)
    assert '| 100 |' in found
