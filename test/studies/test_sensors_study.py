# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real odometry, IMUs and accelerometers compared with the assumed deviations."""

import re

import numpy as np
import pytest

from studies.sensors import angle_table, read_robot, restarts_table, vertical_rows

pytestmark = pytest.mark.full


def numbers(row):
    return [float(number) for number in re.findall(r'-?\d+\.?\d*', row.replace('test1', ''))]


def test_the_deviations_of_odometry_cover_a_real_husky(shared_data):
    robot = read_robot(shared_data / 'rooms/real_odometry_bags/test1.bag')
    rows = [numbers(row) for row in angle_table(robot).splitlines() if re.match(r'\| [0-9]', row)]
    ways, of_map, of_looks = np.array([(row[0], row[-2], row[-1]) for row in rows]).T
    assert list(ways) == [0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0]
    assert (of_map < 1.0).all() and (of_looks < 1.0).all()
    medians = {row[0]: float(row[3]) for row in vertical_rows(robot)}
    drives = [value for name, value in medians.items() if name.endswith('drives')]
    assert len(drives) == 2 and max(drives) <= 1.0


@pytest.mark.parametrize(('bag', 'rate_hz'), [('test1', 5.0), ('test2', 50.0)])
def test_no_restart_is_seen_in_a_drive_without_any(shared_data, bag, rate_hz):
    """With and without lost messages."""
    robot = read_robot(shared_data / f'rooms/real_odometry_bags/{bag}.bag')
    (row,) = restarts_table(robot, [rate_hz], 1).splitlines()[2:]
    assert numbers(row)[-2:] == [0, 0]
