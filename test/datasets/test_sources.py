# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read frames with poses and depth from recordings made here."""

import pickle
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rig_bag import (
    camera_messages,
    depth_message,
    make,
    pose_messages,
    tf_messages,
    write_messages,
)
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_frames, find_topics
from cliploc_ros.offline.datasets.bag_poses import PoseSource, bag_odometry
from cliploc_ros.offline.datasets.poses import mount_from_numbers

MS = 1_000_000
START = 1_700_000_000_000 * MS
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, 'plumb_bob', (0.0,) * 5)
COMPRESSED = 'sensor_msgs/msg/CompressedImage'


def header(stamp, frame_id):
    return bag_messages.pose_message(stamp, frame_id, np.eye(4)).header


def pose_at(x, turn_deg=0.0):
    return make_transform(Rotation.from_euler('z', turn_deg, degrees=True).as_matrix(),
                          np.array([x, 0.0, 0.0]))


def compressed_depth(stamp, encoding, values, a=0.0, b=0.0):
    """Make a message of compressed_depth_image_transport: uint16 values (h, w), a and b."""
    png = cv2.imencode('.png', values)[1].tobytes()
    data = np.frombuffer(struct.pack('<iff', 0, a, b) + png, dtype=np.uint8)
    return make(COMPRESSED, header=header(stamp, 'camera'), data=data,
                format=f'{encoding}; compressedDepth png')


def write_bag(path, images_ms, messages):
    """Write images at stamps [ms], and other messages."""
    shown = [message for t in images_ms for message in camera_messages(
        START + t * MS, np.full((48, 64, 3), t % 200, dtype=np.uint8), CAMERA)]
    return write_messages(path, [*shown, *messages])


def drive(stamps_ms=range(0, 1001, 100), offset_ns=0):
    """Return poses of a body that drives 1 m in 1 s, as PoseStamped."""
    return pose_messages([(START + t * MS, pose_at(t / 1000)) for t in stamps_ms],
                         late_ns=offset_ns)


def positions(frames):
    return [None if frame.map_from_camera is None
            else pytest.approx(frame.map_from_camera[0, 3], abs=1e-9) for frame in frames.read()]


def test_poses_are_interpolated_within_a_gap(tmp_path):
    bag = write_bag(tmp_path / 'bag', [250, 500, 710, 950], drive([0, 200, 300, 600, 1000]))
    assert positions(bag_frames(bag, BagTopics(), PoseSource('/pose'))) == [None] * 4
    frames = bag_frames(bag, BagTopics(), PoseSource('/pose', topic_gap_ns=300 * MS))
    assert positions(frames) == [0.25, 0.5, None, None]
    assert frames.count == 4
    raw = list(frames.read_raw(lambda place, stamp, pose: pose is not None and place > 0))
    assert [frame.place for frame in raw] == [1]
    # another process decodes it
    decoded = pickle.loads(pickle.dumps(raw[0])).decode()
    assert (decoded.image_rgb == 500 % 200).all() and decoded.camera.fx == 50.0


@pytest.mark.parametrize(('camera', 'frame_id', 'topic', 'error', 'note'), [
    (replace(CAMERA, cx=63.0, cy=47.0), 'camera', '/image', '126x94 px', None),
    (replace(CAMERA, distortion=(-0.3, 0.1, 0.0, 0.0)), 'camera', '/image_rect',
     'rectified is false', None),
    (replace(CAMERA, cx=42.0), 'camera', '/image', None, '84x47 px'),
    (CAMERA, 'other', '/image', None, "'other'"), (CAMERA, 'camera', '/image_rect', None, None)])
def test_what_contradicts_itself_in_a_recording(tmp_path, camera, frame_id, topic, error, note):
    """The node's functions check them: refused, or reported in a note."""
    blank = np.zeros((48, 64, 3), dtype=np.uint8)
    (_, _, kind, image), _ = camera_messages(START, blank, camera)
    _, info = camera_messages(START, blank, camera, frame_id)
    write_messages(tmp_path / 'bag', [(START, topic, kind, image), info,
                                      *pose_messages([(START, np.eye(4))])])

    def read():
        frames = bag_frames(tmp_path / 'bag', BagTopics(topic, info[1]), PoseSource('/pose'))
        return list(frames.read()), frames.notes
    if error is not None:
        with pytest.raises(DatasetError, match=error):
            read()
    else:
        frames, notes = read()
        assert len(frames) == 1
        assert [note in one for one in notes] == [True] * (note is not None)


def test_the_only_topics_and_poses_are_found(tmp_path):
    bag = write_bag(tmp_path / 'bag', [450], [
        *moving_tf(), (START + 450 * MS, '/image/compressed', COMPRESSED, make(
            COMPRESSED, header=header(START, 'camera'), format='jpeg',
            data=np.zeros(1, np.uint8))),
        (START, '/depth/image', bag_messages.IMAGE, depth_message(START, np.ones((2, 2))))])
    assert find_topics(bag, None, None) == ('/image', '/camera_info')
    frame, = bag_frames(bag, BagTopics(), PoseSource(max_gap_ns=1000 * MS)).read()
    expected, = bag_frames(bag, BagTopics(), of_tf('map', 1000)).read()
    np.testing.assert_array_equal(frame.map_from_camera, expected.map_from_camera)


def test_a_covariance_with_a_mount(tmp_path):
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    with_covariance = [(START + t * MS, '/amcl_pose', kind, make(
        kind, header=header(START + t * MS, 'map'),
        pose=make('geometry_msgs/msg/PoseWithCovariance', covariance=np.zeros(36),
                  pose=bag_messages.pose_message(0, '', pose_at(t / 1000, 90.0)).pose)))
        for t in (0, 100)]
    bag = write_bag(tmp_path / 'bag', [50], with_covariance)
    mount = mount_from_numbers([0.3, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
    frame, = bag_frames(bag, BagTopics(), PoseSource(
        '/amcl_pose', topic_gap_ns=200 * MS, body_from_camera=mount)).read()
    np.testing.assert_allclose(frame.map_from_camera[:3, 3], [0.05, 0.3, 0.5], atol=1e-9)


def moving_tf(*, static=True):
    """Return a map corrected at 1 Hz, odometry at 10 Hz, and a camera 0.2 m ahead."""
    return [*tf_messages([(START + t * MS, pose_at(0.0, 90.0 * t / 1000)) for t in (0, 1000)],
                         'map', 'odom'),
            *tf_messages([(START + t * MS, pose_at(t / 1000)) for t in range(0, 1001, 100)],
                         'odom', 'base'),
            *static * tf_messages([(START, pose_at(0.2))], 'base', '/camera', '/tf_static')]


def of_tf(map_frame, max_gap_ms, camera_frame=None):
    return PoseSource(map_frame=map_frame, camera_frame=camera_frame, max_gap_ns=max_gap_ms * MS)


def test_tf_is_composed_at_the_stamp_of_the_image(tmp_path):
    bag = write_bag(tmp_path / 'bag', [450], moving_tf())
    frame, = bag_frames(bag, BagTopics(), of_tf('map', 1000)).read()
    expected = pose_at(0.0, 90.0 * 0.45) @ pose_at(0.45) @ pose_at(0.2)
    np.testing.assert_allclose(frame.map_from_camera, expected, atol=1e-9)
    # the corrections are too infrequent for a smaller gap
    frame, = bag_frames(bag, BagTopics(), of_tf('map', 500)).read()
    assert frame.map_from_camera is None
    # a map that is a leaf of the tree
    frame, = bag_frames(bag, BagTopics(), of_tf('base', 0)).read()
    np.testing.assert_allclose(frame.map_from_camera, pose_at(0.2), atol=1e-9)


def test_the_second_camera_of_a_stereo_pair_is_beside_its_frame(tmp_path):
    *image, info = camera_messages(START, np.zeros((48, 64, 3), np.uint8), CAMERA)
    p = np.array([50.0, 0.0, 31.5, -6.0, 0.0, 50.0, 23.5, 0.0, 0.0, 0.0, 1.0, 0.0])
    bag = write_messages(tmp_path / 'bag', [*image, (*info[:3], replace(info[3], p=p)),
                                            *moving_tf()])
    frames = bag_frames(bag, BagTopics(), of_tf('map', 1000))
    odometry = bag_odometry(bag, '/image', of_tf('odom', 200), '/camera_info')
    for pose in (next(frames.read()).map_from_camera, odometry.pose_at(START)):
        np.testing.assert_allclose(pose, pose_at(0.32), atol=1e-9)
    assert 'second camera of a stereo pair, 0.12 m' in ' '.join(frames.notes)


def test_odometry_is_read_from_tf(tmp_path):
    bag = write_bag(tmp_path / 'bag', [450], moving_tf())
    odometry = bag_odometry(bag, '/image', of_tf('odom', 200))
    # map -> odom changes, and is not included
    np.testing.assert_allclose(odometry.pose_at(START + 450 * MS), pose_at(0.65), atol=1e-9)
    assert odometry.pose_at(START + 1200 * MS) is None
    other = write_bag(tmp_path / 'other', [0, 900], drive(offset_ns=-1_699_999_000 * 10**9))
    with pytest.raises(DatasetError, match='different clocks'):
        bag_odometry(other, '/image', PoseSource('/pose'))


@pytest.mark.parametrize(('messages', 'frames', 'expected'), [
    (moving_tf(), ('world', 'camera'), "'world'; it has base"),
    (moving_tf(static=False), ('map', 'camera'), "frame 'camera'"),
    ([*moving_tf(static=False), *tf_messages([(START, np.eye(4))], 'arm', topic='/tf_static')],
     ('map', 'camera'), "'map' and 'arm'"),
    ([*moving_tf(), *tf_messages([(START, np.eye(4))], 'other_odom', 'base')], ('map', 'camera'),
     "'base' has two")])
def test_tf_that_does_not_serve(tmp_path, messages, frames, expected):
    bag = write_bag(tmp_path / 'bag', [450], messages)
    with pytest.raises(DatasetError, match=expected):
        bag_frames(bag, BagTopics(), of_tf(frames[0], 1000, frames[1]))


def test_depth_is_paired_with_the_nearest_image(tmp_path):
    depths = [(START + (t + 4) * MS, '/depth', bag_messages.IMAGE, depth_message(
        START + t * MS, np.full((48, 64), value, dtype=np.uint16)))
        for t, value in ((0, 1000), (95, 2000), (130, 3000), (400, 0))]
    bag = write_bag(tmp_path / 'bag', [0, 100, 300, 400], [*drive(), *depths])
    frames = bag_frames(bag, BagTopics(depth='/depth'), PoseSource('/pose', topic_gap_ns=200 * MS))
    shown = [None if frame.depth is None else frame.depth.depths_m[0, 0]
             for frame in frames.read()]
    assert shown[:3] == [pytest.approx(1.0), pytest.approx(2.0), None]
    assert np.isnan(shown[3])


def test_compressed_depth(tmp_path):
    """Counts are read as they are; floats as quantized inverse depth, as the transport does."""
    counts = np.array([[0, 700], [1500, 65535]], dtype=np.uint16)
    depths = np.array([[0.7, 1.5], [4.0, 9.0]])
    quantization, farthest_m = 100.0, 10.0
    a = quantization * (quantization + 1.0)
    b = 1.0 - a / farthest_m
    inverse = (a / depths + b).astype(np.uint16)
    inverse[0, 0] = 0  # no depth
    cut = compressed_depth(START + 200 * MS, '16UC1', counts)
    cut.data = cut.data[:30]
    bag = write_bag(tmp_path / 'bag', [0, 100, 200], [
        *drive(), *((START + t * MS + MS, '/depth', COMPRESSED, message) for t, message in (
            (0, compressed_depth(START, '16UC1', counts)),
            (100, compressed_depth(START + 100 * MS, '32FC1', inverse, a, b)), (200, cut)))])
    frames = bag_frames(bag, BagTopics(depth='/depth'), PoseSource('/pose')).read()
    np.testing.assert_allclose(next(frames).depth.depths_m, [[np.nan, 0.7], [1.5, np.nan]],
                               rtol=1e-6)
    np.testing.assert_allclose(next(frames).depth.depths_m, [[np.nan, 1.5], [4.0, 9.0]], rtol=0.02)
    with pytest.raises(DatasetError, match='/depth at 17'):
        next(frames)
