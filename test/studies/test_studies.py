# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies: results and their pages, rooms, sensors, wrong sensors, speed and the watch."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scene import CAMERA

from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.posed_query import PosedQuery
from demo import ASSETS
from studies import results, wrong_sensors
from studies.acceptance.__main__ import run as run_acceptance
from studies.sensors import angle_table, read_robot, restarts_table, vertical_rows
from studies.watch.__main__ import run as run_watch
from studies.watch.judge import KIDNAPPED, alarm_table, judge, right_table, simulated_drive
from studies.watch.recordings import WatchedLook, alarms_of, summarize_watch

pytestmark = pytest.mark.full


def test_a_result_has_its_command_and_its_sections_and_an_edit_by_hand_is_noticed(
        tmp_path, monkeypatch):
    monkeypatch.setattr(results, 'FOLDER', tmp_path)
    path = tmp_path / 'small.md'
    results.measure('small', 'studies.acceptance judge --worlds 1 --kinds room', tmp_path)
    text = path.read_text()
    assert '| command | `python -m studies.acceptance judge --worlds 1 --kinds room` |' in text
    assert results.section('small', 'At a glance').startswith('| place | one image |')
    with pytest.raises(ValueError, match='no section In short, but At a glance'):
        results.section('small', 'In short')
    with pytest.raises(ValueError, match=r'gone\.md is missing'):
        results.section('gone', 'At a glance')
    for edited in (text.replace(' of ', ' out of ', 1), 'no digest\n'):
        path.write_text(edited)
        with pytest.raises(ValueError, match=r'small\.md is missing or was edited: run python -m'):
            results.section('small', 'At a glance')


def test_a_command_that_fails_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(results, 'FOLDER', tmp_path)
    with pytest.raises(results.OptionsError, match='small: the command ended with 2'):
        results.measure('small', 'studies.acceptance judge --no-such-option', tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.clock
def test_the_kernel_is_two_orders_faster_than_a_plain_loop_and_as_good():
    done = subprocess.run([sys.executable, '-m', 'studies.speed', 'search', '--landmarks',
                           '100', '1000'], capture_output=True, text=True, check=True)
    print(f'\n{done.stdout}')
    ratio = float(re.search(r'(\d+) times as long', done.stdout).group(1))
    ours, plain = re.search(r'score ([\d.]+), plain ([\d.]+)', done.stdout).groups()
    assert ratio > 120
    assert float(ours) == pytest.approx(float(plain), abs=5e-3)


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


@pytest.mark.parametrize(('change', 'level', 'expected'), [
    (wrong_sensors.middle_crop, 300.0, (12.5, 125.0, 137.5, 150.0)),
    (wrong_sensors.scaled_boxes, 0.5, (50.0, 100.0, 150.0, 120.0)),
    (wrong_sensors.shifted_boxes, 0.05, (132.0, 200.0, 332.0, 240.0)),
    (wrong_sensors.turned_boxes, 90.0, (240.0, 100.0, 280.0, 300.0)),
    (wrong_sensors.mirrored_boxes, 1.0, (100.0, 240.0, 300.0, 280.0)),
    (wrong_sensors.of_convention, 0.0, (200.0, 220.0, 200.0, 40.0)),
    (wrong_sensors.of_convention, 2.0, (0.15625, 5 / 12, 0.46875, 0.5))])
def test_boxes_are_of_another_image_or_convention(change, level, expected):
    box = Detections(np.array([[100.0, 200.0, 300.0, 240.0]]), ('cup',), np.ones(1))
    asked = PosedQuery(0, Observation(CAMERA, box), np.eye(4))
    found, = change([asked], level)[0].observation.detections.bboxes_xyxy
    assert tuple(found) == pytest.approx(expected)


def test_the_table_counts_each_request_once(capsys):
    assert run_acceptance(['stress', '--worlds', '1', '--kinds', 'room', '--only',
                           'two identical']) == 0
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == 3, 'one row for each mode'
    for row in rows:
        _, _, _, requests, success, found, false, *_ = row.strip('| ').split(' | ')
        shares = [float(share) for share in success.split()]
        assert int(requests) == 4
        assert 0 <= int(false) <= int(found) <= 4
        assert shares == sorted(shares) and 4 * shares[-1] == round(4 * shares[-1])


@pytest.fixture(scope='module')
def outcomes(tmp_path_factory):
    """Run the study on the demo's room and images without poses; return the outcomes."""
    folder = tmp_path_factory.mktemp('rooms')
    shutil.copytree(ASSETS / 'mapping', folder / 'demo')
    (folder / 'elsewhere' / 'images').mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(3):
        coarse = rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / 'elsewhere' / 'images' / f'{number}.jpg'),
                    cv2.resize(coarse, (640, 480)))
    done = subprocess.run(
        [sys.executable, '-m', 'studies.rooms', folder / 'demo', folder / 'elsewhere', '--model',
         ASSETS / 'yolo.onnx', '--kinds', 'in turn', '--images', '3',
         '--elsewhere', '2', '--out', folder / 'out'], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / 'out/outcomes.json').read_text())


def test_images_between_the_mapped_ones_are_found(outcomes):
    for way, least in (('objects', 0.4), ('both', 0.75)):  # half of the images are mapped
        errors = [outcome['error_m'] for outcome in outcomes
                  if outcome['way'] == way and outcome['known'] == '-'
                  and outcome['asked'] == 'demo']
        assert len(errors) == 6
        assert np.mean(np.array(errors) < 0.25) >= least


def test_nothing_is_accepted_elsewhere(outcomes):
    elsewhere = [outcome for outcome in outcomes if outcome['asked'] == 'elsewhere']
    assert len(elsewhere) == 2 * 2 * 3  # parts, images, ways
    assert not any(outcome['accepted'] for outcome in elsewhere)


def test_wrong_poses_are_noticed_and_right_ones_are_not_lost():
    right, alarms = judge(simulated_drive('room', 1000, 80), 0, wrong_poses=True)
    assert 'lost' not in right.states
    assert {'2 m', '30 deg', KIDNAPPED} <= {alarm.case for alarm in alarms}
    jumps = [alarm.lost for alarm in alarms if alarm.case not in ('1 m', KIDNAPPED)]
    assert np.mean(jumps) > 0.9
    assert '| room |' in right_table([right]) and '| all |' in alarm_table(alarms)


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
    assert found['alarms'] == 2 and found['false_alarms'] == 1
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
    run_watch(list(map(str, ('localizer', '--observations', tmp_path / 'seen.npz', '--map',
                       office / 'map.yaml', '--out', tmp_path, '--period', 0.5, '--truth',
                       office / 'groundtruth.txt'))))
    found = json.loads((tmp_path / 'watch.json').read_text())
    assert found['looks'] == len(found['every_look']) == 48 and found['alarms'] == 1
    assert found['false_alarms'] == 0
    stretch, = found['wrong_stretches']
    assert stretch['looks'] <= 5
    assert 'localized' in {look['state'] for look in found['every_look'][2:7]}
    assert found['every_look'][-1]['error_m'] == pytest.approx(2.0, abs=0.1)
