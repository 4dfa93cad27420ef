# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable tum_to_bag, as users run it."""

import os
import signal

import cv2
import numpy as np
import pytest
from executables import wait_until

from cliploc_ros.cli.tum_to_bag import main
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagReader


def read_all(bag):
    """Return the deserialized messages by topic, after checking their stamps."""
    by_topic = {}
    with BagReader(bag) as reader:
        for raw in reader.messages():
            message = reader.deserialize(raw)
            assert bag_messages.stamp_ns(message) == raw.stamp_ns
            by_topic.setdefault(raw.topic, []).append(message)
    return by_topic


def decode_rgb(message):
    if hasattr(message, 'format'):
        return cv2.cvtColor(cv2.imdecode(message.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert message.encoding == 'rgb8'
    return message.data.reshape(message.height, message.width, 3)


@pytest.mark.parametrize(('storage', 'form'), [('sqlite3', 'raw'), ('mcap', 'compressed')])
def test_small_sequence_round_trip(make_sequence, tmp_path, run_here, storage, form):
    sequence = make_sequence()
    done = run_here(main, sequence.folder, tmp_path / 'bag', '--storage', storage, f'--{form}',
                    '--detections', sequence.detections, '--prefix', 'front/camera')
    assert done.returncode == 0, done.stderr
    assert '4 images, 3 ground' in done.stdout
    assert '1 images have no' in done.stdout

    topics = read_all(tmp_path / 'bag')
    images = '/front/camera/image' + ('/compressed' if form == 'compressed' else '')
    assert list(topics) == [images, *(f'/front/camera/{name}' for name in (
        'camera_info', 'detections', 'ground_truth'))]
    stamps = [round(float(stamp) * 10) * 100_000_000 for stamp in sequence.stamps]
    for name in list(topics)[:3]:
        assert [bag_messages.stamp_ns(message) for message in topics[name]] == stamps
        assert {one.header.frame_id for one in topics[name]} == {'camera_optical_frame'}
    for message, expected_bgr in zip(topics[images], sequence.images_bgr, strict=True):
        np.testing.assert_array_equal(decode_rgb(message), expected_bgr[:, :, ::-1])
    if form == 'compressed':
        assert {message.format for message in topics[images]} == {'rgb8; png compressed bgr8'}
        first = (sequence.folder / 'rgb' / f'{sequence.stamps[0]}.png').read_bytes()
        assert topics[images][0].data.tobytes() == first
    assert [len(one.detections) for one in topics['/front/camera/detections']] == [0, 1, 2, 0]
    (pose, *_) = topics['/front/camera/ground_truth']
    assert pose.header.frame_id == 'world'
    assert (bag_messages.stamp_ns(pose), pose.pose.position.x) == (stamps[1], 0)


def test_accelerations_become_an_imu(make_sequence, tmp_path, run_here):
    sequence = make_sequence()
    (sequence.folder / 'accelerometer.txt').write_text('# t a\n1.25 0.5 7 -5\n1.5 0.25 8 -6\n')
    done = run_here(main, sequence.folder, tmp_path / 'bag')
    assert done.returncode == 0, done.stderr
    assert '2 accelerations' in done.stdout
    first, second = read_all(tmp_path / 'bag')['/imu']
    assert bag_messages.stamp_ns(first) == 1_250_000_000
    assert first.header.frame_id == 'imu'
    assert first.orientation_covariance[0] == first.angular_velocity_covariance[0] == -1
    one = second.linear_acceleration
    assert (one.x, one.y, one.z) == (0.25, 8.0, -6.0)
    (sequence.folder / 'accelerometer.txt').write_text('1.25 0.5 nan -5\n')
    done = run_here(main, sequence.folder, tmp_path / 'other')
    assert 'accelerometer.txt:1' in done.stderr
    assert not (tmp_path / 'other').exists()


def test_interruption_leaves_nothing(make_sequence, tmp_path, start):
    sequence = make_sequence()
    image = sequence.folder / 'rgb' / f'{sequence.stamps[0]}.png'
    with (sequence.folder / 'rgb.txt').open('a') as file:
        for index in range(5_000):  # many links to one image: too many to finish before the signal
            os.link(image, sequence.folder / 'rgb' / f'{index}.png')
            file.write(f'{200 + index} rgb/{index}.png\n')
    process = start('tum_to_bag', sequence.folder, tmp_path / 'bag')
    wait_until(lambda: any(tmp_path.glob('.bag.*.partial/bag/bag.db3')))
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert 'interrupted' in errors
    assert 'Traceback' not in errors
    assert [path.name for path in tmp_path.iterdir()] == ['sequence']
