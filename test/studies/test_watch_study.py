# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of the watch: simulated and recorded localizers."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_frames
from cliploc_ros.offline.datasets.bag_messages import pose_message, stamp_ns
from cliploc_ros.offline.datasets.bag_poses import PoseSource, bag_odometry
from cliploc_ros.offline.datasets.bags import BagReader, BagWriter
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.tum import ConversionOptions, convert_tum, read_tum
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions, record_once
from cliploc_ros.ros.conversions import pose_from_msg
from studies.watch.__main__ import run
from studies.watch.judge import KIDNAPPED, alarm_table, judge, right_table, simulated_drive
from studies.watch.recordings import WatchedLook, alarms_of, summarize_watch, write_watch

pytestmark = pytest.mark.full

def test_wrong_poses_are_noticed_and_right_ones_are_not_lost():
    right, alarms = judge(simulated_drive('room', 1000, 80), 0, wrong_poses=True)
    assert 'lost' not in right.states
    assert {'2 m', '30 deg', KIDNAPPED} <= {alarm.case for alarm in alarms}
    jumps = [alarm.lost for alarm in alarms if alarm.case not in ('1 m', KIDNAPPED)]
    assert np.mean(jumps) > 0.9
    assert '| room |' in right_table([right])
    assert '| all |' in alarm_table(alarms)


ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
IMAGES = 24


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


def test_without_truth_nothing_is_false(tmp_path):
    looks = looked(['localized', 'lost'], [None, None], [0.9, 0.01])
    found = summarize_watch(looks)
    assert found['false_alarms'] is None
    assert found['wrong_stretches'] == []
    assert 'false' not in write_watch(tmp_path, looks)
    assert summarize_watch([])['looks'] == 0


@pytest.fixture(scope='module')
def observations(tmp_path_factory):
    """Return the first images of the demo's walk; halfway the localizer jumps by 2 m."""
    folder = tmp_path_factory.mktemp('watched')
    shutil.copytree(ASSETS / 'sequence', folder / 'tum')
    images = folder / 'tum/rgb.txt'
    rows = [line for line in images.read_text().splitlines() if not line.startswith('#')]
    images.write_text('\n'.join(rows[:IMAGES]) + '\n')
    sequence = read_tum(folder / 'tum')
    convert_tum(sequence, find_camera(None, sequence.folder)[0], folder / 'plain',
                ConversionOptions(world_frame='map', image_format='compressed'))
    with BagReader(folder / 'plain') as reader, BagWriter(folder / 'bag') as writer:
        for topic in reader.topics.values():
            writer.add_topic(topic.name, topic.msgtype)
        for name in ('/localizer', '/wheels'):
            writer.add_topic(name, 'geometry_msgs/msg/PoseStamped')
        for message in reader.messages():
            writer.write(message.topic, message.stamp_ns, message.data)
            if message.topic == '/ground_truth':
                truth = reader.deserialize(message)
                pose, stamp = pose_from_msg(truth.pose), stamp_ns(truth)
                jump = 2.0 * (stamp > sequence.stamps_ns[IMAGES // 2])
                writer.write('/wheels', message.stamp_ns, pose_message(stamp, 'odom', pose))
                writer.write('/localizer', message.stamp_ns, pose_message(
                    stamp, 'map', make_transform(np.eye(3), np.array([jump, 0.1, 0.0])) @ pose))
    frames = bag_frames(folder / 'bag', BagTopics('/image/compressed', '/camera_info'),
                        PoseSource('/localizer', topic_gap_ns=10**9))
    record_once(frames, RecordingOptions(DetectorOptions(str(ASSETS / 'yolo.onnx')), None,
                                         EVERY_FRAME, ''), folder / 'seen.npz',
                {'': bag_odometry(folder / 'bag', '/image/compressed',
                                  PoseSource('/wheels', topic_gap_ns=10**9))})
    return folder / 'seen.npz'


def watch(observations, out, *arguments):
    run(list(map(str, ('localizer', '--observations', observations, '--map', ASSETS / 'map.yaml',
                       '--out', out, *arguments))))
    return json.loads((out / 'watch.json').read_text())


def test_a_localizer_that_jumps_is_noticed(observations, tmp_path):
    found = watch(observations, tmp_path, '--period', 0.5, '--truth',
                  ASSETS / 'sequence/groundtruth.txt')
    assert found['looks'] == len(found['every_look']) == IMAGES
    assert found['alarms'] == 1
    assert found['false_alarms'] == 0
    stretch, = found['wrong_stretches']
    assert stretch['looks'] <= 5
    assert 'localized' in {look['state'] for look in found['every_look'][2:7]}
    assert found['every_look'][-1]['error_m'] == pytest.approx(2.0, abs=0.1)
