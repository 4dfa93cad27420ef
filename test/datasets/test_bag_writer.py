# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write recordings: round trip, Jazzy's metadata, and no remains after a failure."""


import numpy as np
import pytest
import yaml

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.messages import detections_from_msg
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import LATCHED_QOS, RELIABLE_QOS, BagReader, BagWriter
from cliploc_ros.ros.conversions import pose_from_msg

STAMP_NS = 1341847980722988001
CAMERA = Camera(64, 48, 53.5, 53.9, 32.0, 24.7, 'plumb_bob', (0.1, -0.2, 0.001, 0.002, 0.3))


@pytest.fixture(params=['sqlite3', 'mcap'])
def storage(request):
    return request.param


def test_messages_come_back(tmp_path, storage):
    pixels_rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    detections = Detections(np.array([[1.5, 2.0, 30.25, 40.0], [0.0, 0.0, 63.0, 47.0]]),
                            ('teddy bear', 'tv'), np.array([0.5, 0.25]))
    map_from_camera = transform_from_pose(np.array([1.0, -2.0, 3.0]),
                                          np.array([0.5, 0.5, -0.5, 0.5]))
    written = {
        bag_messages.IMAGE: bag_messages.image_message(STAMP_NS, 'camera', pixels_rgb),
        bag_messages.CAMERA_INFO: bag_messages.camera_info_message(STAMP_NS, 'camera', CAMERA),
        bag_messages.DETECTIONS: bag_messages.detections_message(STAMP_NS, 'camera', detections),
        bag_messages.POSE: bag_messages.pose_message(STAMP_NS, 'world', map_from_camera)}
    with BagWriter(tmp_path / 'bag', storage) as bag:
        for number, (msgtype, message) in enumerate(written.items()):
            bag.add_topic(f'/topic_{number}', msgtype)
            bag.write(f'/topic_{number}', STAMP_NS, message)
    with BagReader(tmp_path / 'bag') as reader:
        raws = sorted(reader.messages(), key=lambda one: one.topic)
        image, info, array, pose = map(reader.deserialize, raws)
    assert {raw.stamp_ns for raw in raws} == {bag_messages.stamp_ns(image)} == {STAMP_NS}
    assert (image.encoding, image.height, image.width, image.step) == ('rgb8', 48, 64, 192)
    assert image.header.frame_id == 'camera'
    np.testing.assert_array_equal(image.data.reshape(48, 64, 3), pixels_rgb)
    assert (info.width, info.height, info.distortion_model) == (64, 48, 'plumb_bob')
    assert list(info.d) == [0.1, -0.2, 0.001, 0.002, 0.3]
    assert list(info.k) == [53.5, 0, 32.0, 0, 53.9, 24.7, 0, 0, 1]
    assert list(info.p) == [53.5, 0, 32.0, 0, 0, 53.9, 24.7, 0, 0, 0, 1, 0]
    assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert [bag_messages.stamp_ns(one) for one in (array, *array.detections)] == [STAMP_NS] * 3
    again = detections_from_msg(array)
    np.testing.assert_array_equal(again.bboxes_xyxy, detections.bboxes_xyxy)
    np.testing.assert_array_equal(again.scores, detections.scores)
    assert again.class_ids == detections.class_ids
    assert pose.header.frame_id == 'world'
    np.testing.assert_allclose(pose_from_msg(pose.pose), map_from_camera, atol=1e-15)


def test_metadata_is_as_jazzy_reads_it(tmp_path, storage):
    with BagWriter(tmp_path / 'office', storage) as bag:
        bag.add_topic('/pose', bag_messages.POSE, RELIABLE_QOS)
        bag.add_topic('/map', bag_messages.DETECTIONS, LATCHED_QOS)
        for index in range(3):
            message = bag_messages.pose_message(STAMP_NS + index, 'world', np.eye(4))
            bag.write('/pose', STAMP_NS + index, message)
    content = yaml.safe_load((tmp_path / 'office' / 'metadata.yaml').read_text())
    info = content['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, storage)
    assert info['message_count'] == 3
    assert info['starting_time'] == {'nanoseconds_since_epoch': STAMP_NS}
    assert info['duration'] == {'nanoseconds': 2}
    (file,) = info['relative_file_paths']
    assert (tmp_path / 'office' / file).exists()
    infinite = {'sec': 9223372036, 'nsec': 854775807}
    offered = {
        'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile',
        'deadline': infinite, 'lifespan': infinite, 'liveliness': 'automatic',
        'liveliness_lease_duration': infinite, 'avoid_ros_namespace_conventions': False,
    }
    latched = offered | {'depth': 1, 'durability': 'transient_local'}
    topics = [one['topic_metadata'] for one in info['topics_with_message_count']]
    assert [one['offered_qos_profiles'] for one in topics] == [[offered], [latched]]
    assert [one['serialization_format'] for one in topics] == ['cdr', 'cdr']
    assert topics[1]['type_description_hash'].startswith('RIHS01_2142741200')


def test_existing_output_is_kept(tmp_path, storage):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'precious').write_text('data')
    with pytest.raises(DatasetError, match='exists already'), BagWriter(tmp_path / 'bag', storage):
        pass
    assert [path.name for path in tmp_path.rglob('*')] == ['bag', 'precious']


def test_failure_leaves_nothing(tmp_path, storage):
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / 'bag', storage) as bag:
        bag.add_topic('/pose', bag_messages.POSE)
        bag.write('/pose', 1, bag_messages.pose_message(1, 'world', np.eye(4)))
        assert not (tmp_path / 'bag').exists()  # built beside its final path
        assert len(list(tmp_path.iterdir())) == 1
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []
