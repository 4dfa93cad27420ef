# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of the watch: simulated localizers, and what the watch says of them."""


import numpy as np
import pytest

from studies.watch.judge import KIDNAPPED, alarm_table, judge, right_table, simulated_drive

pytestmark = pytest.mark.full


def test_wrong_poses_are_noticed_and_right_ones_are_not_lost():
    right, alarms = judge(simulated_drive('room', 1000, 80), 0, wrong_poses=True)
    assert 'lost' not in right.states
    assert {'2 m', '30 deg', KIDNAPPED} <= {one.case for one in alarms}
    jumps = [one.lost for one in alarms if one.case not in ('1 m', KIDNAPPED)]
    assert np.mean(jumps) > 0.9
    assert '| room |' in right_table([right])
    assert '| all |' in alarm_table(alarms)
