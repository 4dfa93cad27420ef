# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real odometry, IMUs and accelerometers beside the deviations that are assumed of them."""

import re

import numpy as np
import pytest

from studies.sensors import (
    accelerometer_rows,
    angle_table,
    read_robot,
    topics_table,
    vertical_rows,
)

pytestmark = pytest.mark.full


def numbers(row):
    return [float(one) for one in re.findall(r'-?\d+\.?\d*', row.replace('test1', ''))]


def test_the_deviations_of_odometry_cover_a_real_husky(shared_data):
    robot = read_robot(shared_data / 'rooms/real_odometry_bags/test1.bag')
    assert [row.split(' | ')[-1] for row in topics_table([robot]).splitlines()
            if '/odom ' in row] == ['0 |'], 'no restart is seen in a drive without any'
    rows = [numbers(row) for row in angle_table(robot).splitlines() if re.match(r'\| [0-9]', row)]
    ways, of_map, of_looks = np.array([(one[0], one[-2], one[-1]) for one in rows]).T
    assert list(ways) == [0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0]
    assert (of_map < 1.0).all() and (of_looks < 1.0).all()
    medians = {row[0]: float(row[3]) for row in vertical_rows(robot)}
    drives = [value for name, value in medians.items() if name.endswith('drives')]
    assert len(drives) == 2 and max(drives) <= 1.0


def test_a_hand_held_accelerometer_is_worse_than_the_default(shared_data):
    """So the parameter's text advises 2 degrees. The mount is most of the error."""
    stated, fitted = accelerometer_rows(shared_data / 'rooms/tum_fr1_rpy')
    assert float(fitted[2]) > 0.8 and 1.0 < float(fitted[3]) < 2.5
    assert float(stated[3]) > 2.0 * float(fitted[3])
