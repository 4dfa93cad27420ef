# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings of several files, compressed ones, and damaged ones."""

import pytest
import yaml
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bags import (
    LATCHED_QOS,
    RELIABLE_QOS,
    STORAGES,
    BagMessage,
    BagReader,
    typestore,
)

STRING = 'std_msgs/msg/String'
# From ROS's own generator, not computed here.
STRING_HASH = 'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'
QOS = {'/chatter': RELIABLE_QOS, '/robot_description': LATCHED_QOS, '/status': RELIABLE_QOS}


def make_messages(count):
    """Three topics in turn, the third with the stamp of the second."""
    text = typestore().types[STRING]
    return [BagMessage([*QOS][number % 3], 10**18 + (number - (number % 3 == 2)) * 100_000_001,
                       bytes(typestore().serialize_cdr(text(f'message {number}'), STRING)))
            for number in range(count)]


def write_bag(path, storage, parts, compression='NONE'):
    """Write a recording of several files, as `ros2 bag record` splits it."""
    for index, messages in enumerate(parts):
        writer = Writer(path.parent / f'part_{index}', version=9, storage_plugin=STORAGES[storage])
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        with writer:
            topics = {name: writer.add_connection(name, STRING, typestore=typestore(),
                                                  offered_qos_profiles=[qos])
                      for name, qos in QOS.items()}
            for one in messages:
                writer.write(topics[one.topic], one.stamp_ns, one.data)
    path.mkdir()
    every = []
    for index, _ in enumerate(parts):
        part = path.parent / f'part_{index}'
        every.append(yaml.safe_load((part / 'metadata.yaml').read_text()))
        for file in every[-1]['rosbag2_bagfile_information']['relative_file_paths']:
            (part / file).rename(path / file)
    info = every[0]['rosbag2_bagfile_information']
    for one in (each['rosbag2_bagfile_information'] for each in every[1:]):
        info['relative_file_paths'] += one['relative_file_paths']
        info['files'] += one['files']
        info['message_count'] += one['message_count']
        info['duration']['nanoseconds'] = (
            one['starting_time']['nanoseconds_since_epoch'] + one['duration']['nanoseconds']
            - info['starting_time']['nanoseconds_since_epoch'])
        for topic, more in zip(info['topics_with_message_count'],
                               one['topics_with_message_count'], strict=True):
            topic['message_count'] += more['message_count']
    (path / 'metadata.yaml').write_text(yaml.safe_dump(every[0]))
    return path


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('compression', ['NONE', 'FILE', 'MESSAGE'])
def test_reads_what_jazzy_records(tmp_path, storage, compression):
    messages = make_messages(18)
    bag = write_bag(tmp_path / 'bag', storage, [messages[:6], messages[6:]], compression)
    with BagReader(bag) as reader:
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
        assert list(chosen) == [one for one in messages[3:9] if one.topic != '/status']


def truncate(path, size):
    path.write_bytes(path.read_bytes()[:size])


@pytest.mark.parametrize(('damage', 'reason'), [
    (lambda bag: (bag / 'metadata.yaml').unlink(), 'ros2 bag reindex'),
    (lambda bag: (bag / 'metadata.yaml').write_text('version: 9'), 'rosbag2_bagfile_informa'),
    (lambda bag: (bag / 'part_0.mcap').unlink(), 'part_0.mcap'),
    (lambda bag: truncate(bag / 'part_0.mcap', -20), 'magic')])
def test_broken_recordings_are_refused(tmp_path, damage, reason):
    bag = write_bag(tmp_path / 'bag', 'mcap', [make_messages(30)])
    damage(bag)
    with pytest.raises(DatasetError, match=reason), BagReader(bag) as reader:
        list(reader.messages())


def test_missing_recording_and_topic_are_named(tmp_path):
    with pytest.raises(DatasetError, match='no such recording'), BagReader(tmp_path / 'none'):
        pass
    (tmp_path / 'notes.txt').write_text('hello')
    with pytest.raises(DatasetError, match='txt'), BagReader(tmp_path / 'notes.txt'):
        pass
    bag = write_bag(tmp_path / 'bag', 'mcap', [make_messages(3)])
    with BagReader(bag) as reader, pytest.raises(DatasetError, match='/chatter'):
        reader.topic('/image')
