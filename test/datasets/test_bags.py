# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: write and read back; split, compressed and damaged files."""

import numpy as np
import pytest
import yaml
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.messages import camera_from_msg, detections_from_msg
from cliploc_ros.offline.datasets import bag_messages, bags

STRING = 'std_msgs/msg/String'
# Hashes from ROS's generator, not computed here.
STRING_HASH = 'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'
QOS = {'/chatter': bags.RELIABLE_QOS, '/robot_description': bags.LATCHED_QOS,
       '/status': bags.RELIABLE_QOS}


def make_messages(count):
    """Yield messages of three topics in turn, the third with the stamp of the second."""
    store = bags.typestore()
    text = store.types[STRING]
    return [bags.BagMessage([*QOS][number % 3],
                            10**18 + (number - (number % 3 == 2)) * 100_000_001,
                            bytes(store.serialize_cdr(text(f'message {number}'), STRING)))
            for number in range(count)]


def write_bag(path, storage, messages, compression='NONE'):
    """Write a recording as `ros2 bag record` does; a user has edited the QoS of /status."""
    writer = Writer(path, version=9, storage_plugin=bags.STORAGES[storage])
    writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        topics = {name: writer.add_connection(name, STRING, typestore=bags.typestore(),
                                              offered_qos_profiles=[qos])
                  for name, qos in QOS.items()}
        for message in messages:
            writer.write(topics[message.topic], message.stamp_ns, message.data)
    content = yaml.safe_load((path / 'metadata.yaml').read_text())
    status = content['rosbag2_bagfile_information']['topics_with_message_count'][2]
    status['topic_metadata']['offered_qos_profiles'][0]['depth'] = 7
    (path / 'metadata.yaml').write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize('storage', bags.STORAGES)
@pytest.mark.parametrize('compression', ['NONE', 'FILE', 'MESSAGE'])
def test_reads_what_jazzy_records(tmp_path, storage, compression):
    messages = make_messages(18)
    bag = write_bag(tmp_path / 'bag', storage, messages, compression)
    with bags.BagReader(bag) as reader:
        assert list(reader.messages()) == messages
        assert reader.message_count == 18
        assert (reader.start_ns, reader.end_ns) == (messages[0].stamp_ns, messages[-1].stamp_ns)
        assert {(topic.msgtype, topic.type_hash, topic.message_count)
                for topic in reader.topics.values()} == {(STRING, STRING_HASH, 6)}
        (latched,) = reader.topic('/robot_description').offered_qos
        assert latched.durability == QosDurability.TRANSIENT_LOCAL
        assert reader.deserialize(messages[0]).data == 'message 0'
        chosen = reader.messages(['/chatter', '/robot_description'], messages[3].stamp_ns,
                                 messages[9].stamp_ns)
        assert list(chosen) == [message for message in messages[3:9] if message.topic != '/status']
        with pytest.raises(DatasetError, match='/chatter'):
            reader.topic('/image')


def truncate(path, size):
    path.write_bytes(path.read_bytes()[:size])


@pytest.mark.parametrize(('damage', 'reason'), [
    (lambda bag: (bag / 'metadata.yaml').unlink(), 'ros2 bag reindex'),
    (lambda bag: (bag / 'bag.mcap').unlink(), 'bag.mcap'),
    (lambda bag: truncate(bag / 'bag.mcap', -20), 'magic')])
def test_broken_recordings_are_refused(tmp_path, damage, reason):
    bag = write_bag(tmp_path / 'bag', 'mcap', make_messages(30))
    damage(bag)
    with pytest.raises(DatasetError, match=reason), bags.BagReader(bag) as reader:
        list(reader.messages())


STAMP_NS = 1341847980722988001
CAMERA = Camera(64, 48, 53.5, 53.9, 32.0, 24.7, 'plumb_bob', (0.1, -0.2, 0.001, 0.002, 0.3))


def test_messages_come_back(tmp_path):
    """Those that other tests of bags do not read: a lens, detections."""
    detections = Detections(np.array([[1.5, 2.0, 30.25, 40.0], [0.0, 0.0, 63.0, 47.0]]),
                            ('teddy bear', 'tv'), np.array([0.5, 0.25]))
    with bags.BagWriter(tmp_path / 'bag') as bag:
        for topic, msgtype, message in (
                ('/a', bag_messages.CAMERA_INFO,
                 bag_messages.camera_info_message(STAMP_NS, 'camera', CAMERA)),
                ('/b', bag_messages.DETECTIONS,
                 bag_messages.detections_message(STAMP_NS, 'camera', detections))):
            bag.add_topic(topic, msgtype)
            bag.write(topic, STAMP_NS, message)
    with bags.BagReader(tmp_path / 'bag') as reader:
        info, array = map(reader.deserialize, sorted(reader.messages(), key=lambda one: one.topic))
    assert camera_from_msg(info, (64, 48), False) == CAMERA
    assert list(info.p) == [53.5, 0, 32.0, 0, 0, 53.9, 24.7, 0, 0, 0, 1, 0]
    stamps_ns = [bag_messages.stamp_ns(message) for message in (info, array, *array.detections)]
    assert stamps_ns == [STAMP_NS] * 4
    again = detections_from_msg(array)
    np.testing.assert_array_equal(again.bboxes_xyxy, detections.bboxes_xyxy)
    np.testing.assert_array_equal(again.scores, detections.scores)
    assert again.class_ids == detections.class_ids


@pytest.mark.parametrize('plugin', bags.STORAGES)
def test_metadata_is_as_jazzy_reads_it(tmp_path, plugin):
    with bags.BagWriter(tmp_path / 'office', plugin) as bag:
        bag.add_topic('/pose', bag_messages.POSE, bags.RELIABLE_QOS)
        bag.add_topic('/map', bag_messages.DETECTIONS, bags.LATCHED_QOS)
        for index in range(3):
            message = bag_messages.pose_message(STAMP_NS + index, 'world', np.eye(4))
            bag.write('/pose', STAMP_NS + index, message)
    content = yaml.safe_load((tmp_path / 'office' / 'metadata.yaml').read_text())
    info = content['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, plugin)
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
    topics = [topic['topic_metadata'] for topic in info['topics_with_message_count']]
    assert [topic['offered_qos_profiles'] for topic in topics] == [[offered], [latched]]
    assert [topic['serialization_format'] for topic in topics] == ['cdr', 'cdr']
    assert topics[1]['type_description_hash'].startswith('RIHS01_2142741200')


def test_existing_output_is_kept(tmp_path):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'precious').write_text('data')
    with pytest.raises(DatasetError, match='already exists'), bags.BagWriter(tmp_path / 'bag'):
        pass
    assert [path.name for path in tmp_path.rglob('*')] == ['bag', 'precious']


@pytest.mark.parametrize('plugin', bags.STORAGES)
def test_failure_leaves_nothing(tmp_path, plugin):
    with pytest.raises(KeyboardInterrupt), bags.BagWriter(tmp_path / 'bag', plugin) as bag:
        bag.add_topic('/pose', bag_messages.POSE)
        bag.write('/pose', 1, bag_messages.pose_message(1, 'world', np.eye(4)))
        assert not (tmp_path / 'bag').exists()  # written beside its final path
        assert len(list(tmp_path.iterdir())) == 1
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
