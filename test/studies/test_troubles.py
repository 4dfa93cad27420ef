# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of maps, detections and sensors are applied as described; every request counts."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.evaluation import trials
from studies import wrong_sensors
from studies.acceptance.__main__ import run
from studies.acceptance.places import Simulated

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def place():
    return Simulated('room', 1000).load()


@pytest.fixture(scope='module')
def queries(place):
    """Queries with true verticals and odometry."""
    return trials.with_neighbours(trials.with_vertical(place.frames), place.groups)


@pytest.mark.parametrize(('change', 'level', 'expected'), [
    (wrong_sensors.middle_crop, 300.0, (12.5, 125.0, 137.5, 150.0)),
    (wrong_sensors.scaled_boxes, 0.5, (50.0, 100.0, 150.0, 120.0)),
    (wrong_sensors.shifted_boxes, 0.05, (132.0, 200.0, 332.0, 240.0)),
    (wrong_sensors.turned_boxes, 90.0, (240.0, 100.0, 280.0, 300.0)),
    (wrong_sensors.mirrored_boxes, 0.0, (340.0, 200.0, 540.0, 240.0)),
    (wrong_sensors.mirrored_boxes, 1.0, (100.0, 240.0, 300.0, 280.0)),
    (wrong_sensors.of_convention, 0.0, (200.0, 220.0, 200.0, 40.0)),
    (wrong_sensors.of_convention, 2.0, (0.15625, 5 / 12, 0.46875, 0.5)),
    (wrong_sensors.of_convention, 5.0, (100.0, 200.0, 400.0, 440.0))])
def test_boxes_are_of_another_image_or_convention(queries, change, level, expected):
    box = Detections(np.array([[100.0, 200.0, 300.0, 240.0]]), ('cup',), np.ones(1))
    asked = replace(queries[0], neighbours=(), observation=replace(
        queries[0].observation, detections=box))
    found, = change([asked], level)[0].observation.detections.bboxes_xyxy
    assert tuple(found) == pytest.approx(expected)


def test_the_table_counts_each_request_once(capsys):
    assert run(['stress', '--worlds', '1', '--kinds', 'room', '--only', 'two identical']) == 0
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == 3, 'one row for each mode'
    for row in rows:
        _, _, _, requests, success, found, false, *_ = row.strip('| ').split(' | ')
        shares = [float(share) for share in success.split()]
        assert int(requests) == 4
        assert 0 <= int(false) <= int(found) <= 4
        assert shares == sorted(shares) and 4 * shares[-1] == round(4 * shares[-1])
