# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable tum_to_bag, as users run it."""

import os
import resource
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
from executables import PROJECT, SIZE, run, wait_until

from cliploc_ros.cli.tum_to_bag import main
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.datasets import bag_messages
from cliploc_ros.datasets.bags import BagReader
from cliploc_ros.datasets.recorded_detections import read_recorded_detections
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.messages import detections_from_msg

FORMS = [(storage, form) for storage in ('sqlite3', 'mcap') for form in ('raw', 'compressed')]


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


@pytest.mark.parametrize(('storage', 'form'), FORMS)
def test_small_sequence_round_trip(make_sequence, tmp_path, storage, form):
    sequence = make_sequence()
    done = run(
        'tum_to_bag', sequence.folder, tmp_path / 'bag', '--storage', storage, f'--{form}',
        '--detections', sequence.detections, '--prefix', 'front/camera',
    )
    assert done.returncode == 0, done.stderr
    assert '4 images, 3 ground-truth poses, 4 detection messages' in done.stdout
    assert '1 images have no ground truth within 20 ms' in done.stdout

    topics = read_all(tmp_path / 'bag')
    images = '/front/camera/image' + ('/compressed' if form == 'compressed' else '')
    assert list(topics) == [
        images, '/front/camera/camera_info', '/front/camera/detections',
        '/front/camera/ground_truth',
    ]
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


@pytest.mark.parametrize(('storage', 'form'), [FORMS[0], FORMS[-1]])
def test_real_sequence_round_trip(shared_data, tmp_path, storage, form):
    folder = shared_data / 'tum_fr3_office'
    done = run(
        'tum_to_bag', folder, tmp_path / 'bag', '--storage', storage, f'--{form}',
        '--detections', folder / 'detections.json',
    )
    assert done.returncode == 0, done.stderr
    assert '17 images, 16 ground-truth poses, 17 detection messages' in done.stdout
    topics = read_all(tmp_path / 'bag')
    sequence = read_tum(folder)
    recorded = read_recorded_detections(folder / 'detections.json')
    images = topics['/image/compressed' if form == 'compressed' else '/image']
    for message, path in zip(images, sequence.image_paths, strict=True):
        expected_bgr = cv2.imread(str(path))
        np.testing.assert_array_equal(decode_rgb(message), expected_bgr[:, :, ::-1])
    for message, stamp in zip(topics['/detections'], sequence.stamps_ns, strict=True):
        detections = detections_from_msg(message)
        np.testing.assert_array_equal(detections.bboxes_xyxy, recorded[stamp].bboxes_xyxy)
        np.testing.assert_array_equal(detections.scores, recorded[stamp].scores)
        assert detections.class_ids == recorded[stamp].class_ids
    for message in topics['/ground_truth']:
        truth = sequence.pose_at(bag_messages.stamp_ns(message))
        error_m, error_deg = pose_error(bag_messages.map_from_camera_of(message), truth)
        assert error_m < 1e-12
        assert error_deg < 1e-6
    assert {tuple(info.k) for info in topics['/camera_info']} == {
        (535.4, 0, 320.1, 0, 539.2, 247.6, 0, 0, 1)
    }


def test_jpeg_bytes_are_copied(make_sequence, tmp_path):
    sequence = make_sequence(count=1, suffix='jpg')
    done = run('tum_to_bag', sequence.folder, tmp_path / 'bag', '--compressed')
    assert done.returncode == 0, done.stderr
    (image,) = read_all(tmp_path / 'bag')['/image/compressed']
    assert image.format == 'rgb8; jpeg compressed bgr8'
    (file,) = (sequence.folder / 'rgb').iterdir()
    assert image.data.tobytes() == file.read_bytes()


def test_accelerations_become_an_imu(make_sequence, tmp_path):
    sequence = make_sequence()
    (sequence.folder / 'accelerometer.txt').write_text('# t a\n1.25 0.5 7 -5\n1.5 0.25 8 -6\n')
    done = run('tum_to_bag', sequence.folder, tmp_path / 'bag')
    assert done.returncode == 0, done.stderr
    assert '2 accelerations' in done.stdout
    first, second = read_all(tmp_path / 'bag')['/imu']
    assert bag_messages.stamp_ns(first) == 1_250_000_000
    assert first.header.frame_id == 'imu'
    assert first.orientation_covariance[0] == first.angular_velocity_covariance[0] == -1
    one = second.linear_acceleration
    assert (one.x, one.y, one.z) == (0.25, 8.0, -6.0)
    (sequence.folder / 'accelerometer.txt').write_text('1.25 0.5 nan -5\n')
    done = run('tum_to_bag', sequence.folder, tmp_path / 'other')
    assert 'accelerometer.txt:1' in done.stderr
    assert not (tmp_path / 'other').exists()


def test_options_reach_the_recording(make_sequence, tmp_path):
    sequence = make_sequence(count=7)
    (sequence.folder / 'groundtruth.txt').unlink()
    done = run(
        'tum_to_bag', sequence.folder, tmp_path / 'bag', '--every', 3,
        '--camera-frame', 'front', '--intrinsics', sequence.folder / 'camera.json',
        '--ros-args', '-r', '__node:=converter',
    )
    assert done.returncode == 0, done.stderr
    assert 'the folder has no ground truth' in done.stdout
    topics = read_all(tmp_path / 'bag')
    assert set(topics) == {'/image', '/camera_info'}
    assert [one.header.stamp.nanosec for one in topics['/image']] == [0, 300_000_000, 600_000_000]
    assert {one.header.frame_id for one in topics['/image']} == {'front'}


def test_needs_no_ros(make_sequence, tmp_path):
    sequence = make_sequence()
    program = (
        "import sys; sys.modules['rclpy'] = sys.modules['vision_msgs'] = None\n"
        'from cliploc_ros.cli.tum_to_bag import main; sys.exit(main(sys.argv[1:]))'
    )
    args = [sequence.folder, tmp_path / 'bag', '--detections', sequence.detections]
    done = subprocess.run(
        [sys.executable, '-c', program, *map(str, args)],
        cwd=PROJECT, capture_output=True, text=True, timeout=120,
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture
def assert_refused(capfd):
    """Call main() here: a process for each refusal would take a second each."""
    sigterm = signal.getsignal(signal.SIGTERM)

    def check(folder, output, args, *messages):
        assert main([str(arg) for arg in (folder, output, *args)]) == 1
        assert_one_line(capfd.readouterr().err, *messages)
        assert_nothing_at(output)

    yield check
    signal.signal(signal.SIGTERM, sigterm)


def assert_one_line(errors, *messages):
    """Expect one line with the error, beside the progress bar and OpenCV's messages."""
    assert errors.splitlines()[-1].startswith('error: ')
    assert 'Traceback' not in errors
    for message in messages:
        assert message in errors


def assert_nothing_at(output):
    assert not output.exists()
    assert not list(output.parent.glob('.*partial'))


def encoded(kind, image):
    return cv2.imencode(kind, image)[1].tobytes()


TALL = np.zeros((SIZE[1] * 2, SIZE[0], 3), dtype=np.uint8)


@pytest.mark.parametrize(('file', 'content', 'messages'), [
    ('rgb/100.200000.png', encoded('.png', TALL)[:20],
     ['100.200000.png', 'cannot be decoded as an image']),
    ('rgb/100.200000.png', b'', ['100.200000.png', 'cannot be decoded as an image']),
    ('rgb/100.200000.png', encoded('.png', TALL), ['100.200000.png', '64x96', '64x48']),
    ('rgb/100.200000.png', encoded('.bmp', TALL[:SIZE[1]]),
     ['100.200000.png', 'neither PNG nor JPEG']),
    ('rgb.txt', None, ['rgb.txt']),
    ('camera.json', None, ['--intrinsics']),
    ('camera.json', b'{', ['camera.json']),
], ids=['truncated', 'empty', 'tall', 'bitmap', 'no list', 'no camera', 'no JSON'])
def test_bad_folders_are_refused(make_sequence, tmp_path, assert_refused, file, content,
                                 messages):
    folder = make_sequence().folder
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_bytes(content)
    assert_refused(folder, tmp_path / 'bag', ['--compressed'], *messages)


def test_bad_options_are_refused(make_sequence, tmp_path, assert_refused):
    sequence = make_sequence()
    for args, message in (
        (['--prefix', '1 camera'], "prefix '1 camera' is no ROS namespace"),
        (['--every', '0'], '1 or more'),
        (['--detections', tmp_path / 'none.json'], 'none.json'),
        (['--intrinsics', 'fr4'], 'fr4'),
    ):
        assert_refused(sequence.folder, tmp_path / 'bag', args, message)


def test_detections_of_another_sequence_are_refused(make_sequence, tmp_path, assert_refused):
    sequence = make_sequence()
    text = sequence.detections.read_text().replace('"100.', '"900.')
    sequence.detections.write_text(text)
    args = ['--detections', sequence.detections]
    assert_refused(sequence.folder, tmp_path / 'bag', args, 'another sequence')


def test_existing_output_is_kept(make_sequence, tmp_path):
    sequence = make_sequence()
    (tmp_path / 'bag').mkdir()
    done = run('tum_to_bag', sequence.folder, tmp_path / 'bag')
    assert done.returncode == 1
    assert 'exists already' in done.stderr
    assert list((tmp_path / 'bag').iterdir()) == []


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_full_disk_leaves_nothing(make_sequence, tmp_path, storage):
    """A limit on the size of files gives the error of a full disk."""
    sequence = make_sequence(count=30)

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    done = run('tum_to_bag', sequence.folder, tmp_path / 'bag', '--storage', storage,
               preexec_fn=limit)
    assert done.returncode == 1
    assert_one_line(done.stderr, 'cannot be written', 'no partial file remains')
    assert_nothing_at(tmp_path / 'bag')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interruption_leaves_nothing(make_sequence, tmp_path, start, number):
    sequence = make_sequence()
    image = sequence.folder / 'rgb' / f'{sequence.stamps[0]}.png'
    with (sequence.folder / 'rgb.txt').open('a') as file:
        for index in range(5_000):  # many links to one image: too many to finish before the signal
            os.link(image, sequence.folder / 'rgb' / f'{index}.png')
            file.write(f'{200 + index} rgb/{index}.png\n')
    process = start('tum_to_bag', sequence.folder, tmp_path / 'bag')
    wait_until(lambda: any(tmp_path.glob('.bag.*.partial/bag/bag.db3')))
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert 'interrupted' in errors
    assert 'Traceback' not in errors
    assert [path.name for path in tmp_path.iterdir()] == ['sequence']
