# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of the watch: simulated and recorded localizers."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from studies.watch.__main__ import run
from studies.watch.judge import KIDNAPPED, alarm_table, judge, right_table, simulated_drive
from studies.watch.recordings import WatchedLook, alarms_of, summarize_watch

pytestmark = pytest.mark.full


def test_wrong_poses_are_noticed_and_right_ones_are_not_lost():
    right, alarms = judge(simulated_drive('room', 1000, 80), 0, wrong_poses=True)
    assert 'lost' not in right.states
    assert {'2 m', '30 deg', KIDNAPPED} <= {alarm.case for alarm in alarms}
    jumps = [alarm.lost for alarm in alarms if alarm.case not in ('1 m', KIDNAPPED)]
    assert np.mean(jumps) > 0.9
    assert '| room |' in right_table([right])
    assert '| all |' in alarm_table(alarms)


def looked(states, errors_m, chances):
    return [WatchedLook(2.0 * row, state, chance, '', 0, 0, (), '', 0.5 * row, error, 0.0)
            for row, (state, error, chance) in enumerate(zip(states, errors_m, chances,
                                                             strict=True))]


def test_figures_of_a_short_drive():
    """Looks 2 s and .5 m apart: one false alarm, then wrong poses that the third look detects."""
    looks = looked(['localized', 'lost', 'lost', 'localized', 'localized', 'uncertain', 'lost'],
                   [0.1, 0.1, 0.2, 0.1, 3.0, 3.0, 3.0], [0.9, 0.04, 0.3, 0.99, 0.95, 0.4, 0.01])
    assert [alarm.stamp_s for alarm in alarms_of(looks)] == [2.0, 12.0]
    found = summarize_watch(looks)
    assert found['alarms'] == 2
    assert found['false_alarms'] == 1
    assert found['false_alarms_per_hour'] == pytest.approx(300.0)  # one alarm in 12 s
    assert found['wrong_stretches'] == [
        {'stamp_s': 8.0, 'seconds': 4.0, 'metres': 1.0, 'looks': 3}]
    assert found['states'] == {'localized': 3, 'uncertain': 1, 'lost': 3}


def test_a_localizer_that_jumps_is_noticed(shared_data, tmp_path):
    """The office at 1 Hz; from the 25th frame on, the localizer is off by 2 m."""
    office = shared_data / 'tum_fr3_office'
    seen = load_observations(office / 'observations.npz')
    stamps = seen.stamps_s - seen.stamps_s[0]
    seen = seen.select_frames(np.searchsorted(stamps, np.arange(0.0, 48.0)))
    poses = seen.map_from_camera.copy()
    poses[24:, 0, 3] += 2.0
    save_observations(tmp_path / 'seen.npz', replace(
        seen.with_poses(poses), odom_from_camera=seen.map_from_camera))
    run(list(map(str, ('localizer', '--observations', tmp_path / 'seen.npz', '--map',
                       office / 'map.yaml', '--out', tmp_path, '--period', 0.5, '--truth',
                       office / 'groundtruth.txt'))))
    found = json.loads((tmp_path / 'watch.json').read_text())
    assert found['looks'] == len(found['every_look']) == 48
    assert found['alarms'] == 1
    assert found['false_alarms'] == 0
    stretch, = found['wrong_stretches']
    assert stretch['looks'] <= 5
    assert 'localized' in {look['state'] for look in found['every_look'][2:7]}
    assert found['every_look'][-1]['error_m'] == pytest.approx(2.0, abs=0.1)
