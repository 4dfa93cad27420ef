# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings in the format of Jazzy's `ros2 bag record` (jazzy_bags), and damaged ones."""

import struct

import jazzy_bags
import pytest
from rosbags.interfaces import QosDurability, QosHistory, QosReliability

from cliploc_ros.datasets.bags import BagMessage, BagReader
from cliploc_ros.errors import DatasetError

START_NS = 1_700_000_000_123_456_789
# From ROS's own generator, not computed here.
STRING_HASH = 'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'


def string_cdr(text: str) -> bytes:
    """Return a std_msgs/String in little-endian CDR, byte by byte."""
    encoded = text.encode() + b'\x00'
    return b'\x00\x01\x00\x00' + struct.pack('<I', len(encoded)) + encoded


CHATTER = jazzy_bags.Topic('/chatter', 'std_msgs/msg/String', 'string data\n', STRING_HASH)
LATCHED = jazzy_bags.Topic('/robot_description', 'std_msgs/msg/String', 'string data\n',
                           STRING_HASH, durability='transient_local')
SENSOR = jazzy_bags.Topic('/status', 'std_msgs/msg/String', 'string data\n', STRING_HASH,
                          reliability='best_effort')
TOPICS = [CHATTER, LATCHED, SENSOR]


def make_messages(first: int, count: int) -> list[jazzy_bags.Message]:
    """Three topics in turn, the third with the stamp of the second."""
    messages = []
    for number in range(first, first + count):
        topic = TOPICS[number % 3].name
        tenth = number - (number % 3 == 2)
        stamp = START_NS + tenth * 100_000_001
        messages.append(jazzy_bags.Message(topic, stamp, string_cdr(f'message {number}')))
    return messages


def as_bag_messages(parts: list[list[jazzy_bags.Message]]) -> list[BagMessage]:
    return [BagMessage(one.topic, one.stamp_ns, one.data) for part in parts for one in part]


FORMS = {
    'sqlite3': ('sqlite3', '', {}),
    'sqlite3, files compressed': ('sqlite3', 'FILE', {}),
    'sqlite3, messages compressed': ('sqlite3', 'MESSAGE', {}),
    'mcap': ('mcap', '', {}),
    'mcap, zstd chunks': ('mcap', '', {'chunk_compression': 'zstd'}),
    'mcap, lz4 chunks': ('mcap', '', {'chunk_compression': 'lz4'}),
    'mcap, no chunks': ('mcap', '', {'chunk_compression': None}),
    'mcap, files compressed': ('mcap', 'FILE', {}),
    'mcap, messages compressed': ('mcap', 'MESSAGE', {}),
}


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('files', [1, 3])
def test_reads_what_jazzy_records(tmp_path, form, files):
    storage, compression, options = FORMS[form]
    parts = [make_messages(index * 6, 6) for index in range(files)]
    bag = jazzy_bags.write_bag(tmp_path / 'bag', storage, TOPICS, parts, compression, **options)

    with BagReader(bag) as reader:
        assert list(reader.messages()) == as_bag_messages(parts)
        assert reader.message_count == 6 * files
        assert (reader.start_ns, reader.end_ns) == (parts[0][0].stamp_ns, parts[-1][-1].stamp_ns)
        assert {topic.msgtype for topic in reader.topics.values()} == {'std_msgs/msg/String'}
        assert {topic.type_hash for topic in reader.topics.values()} == {STRING_HASH}
        assert {topic.message_count for topic in reader.topics.values()} == {2 * files}
        (chatter,) = reader.topic('/chatter').offered_qos
        assert (chatter.history, chatter.depth) == (QosHistory.UNKNOWN, 0)
        assert chatter.reliability == QosReliability.RELIABLE
        (latched,) = reader.topic('/robot_description').offered_qos
        assert latched.durability == QosDurability.TRANSIENT_LOCAL
        (sensor,) = reader.topic('/status').offered_qos
        assert sensor.reliability == QosReliability.BEST_EFFORT
        assert reader.deserialize(next(reader.messages())).data == 'message 0'


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_selects_topics_and_times(tmp_path, storage):
    messages = make_messages(0, 12)
    bag = jazzy_bags.write_bag(tmp_path / 'bag', storage, TOPICS, [messages[:6], messages[6:]])
    start, stop = messages[3].stamp_ns, messages[9].stamp_ns
    expected = [one for one in messages[3:9] if one.topic != '/status']

    with BagReader(bag) as reader:
        found = list(reader.messages(['/chatter', '/robot_description'], start, stop))
    assert found == as_bag_messages([expected])


@pytest.mark.parametrize(
    ('damage', 'reason'),
    [
    (lambda bag: (bag / 'metadata.yaml').unlink(), 'ros2 bag reindex'),
    (lambda bag: (bag / 'metadata.yaml').write_text('version: 9'), 'rosbag2_bagfile_informa'),
    (lambda bag: (bag / 'bag_0.mcap').unlink(), 'bag_0.mcap'),
    (lambda bag: truncate(bag / 'bag_0.mcap', -20), 'magic'),
    (lambda bag: overwrite(bag / 'bag_0.mcap', 700), 'checksum')],
)
def test_broken_recordings_are_refused(tmp_path, damage, reason):
    bag = jazzy_bags.write_bag(tmp_path / 'bag', 'mcap', TOPICS, [make_messages(0, 30)])
    damage(bag)
    with pytest.raises(DatasetError, match=reason), BagReader(bag) as reader:
        list(reader.messages())


def truncate(path, size):
    path.write_bytes(path.read_bytes()[:size])


def overwrite(path, offset):
    data = bytearray(path.read_bytes())
    data[offset:offset + 40] = bytes(40)
    path.write_bytes(data)


def test_missing_recording_and_topic_are_named(tmp_path):
    with pytest.raises(DatasetError, match='no such recording'), BagReader(tmp_path / 'none'):
        pass
    (tmp_path / 'notes.txt').write_text('hello')
    with pytest.raises(DatasetError, match='txt'), BagReader(tmp_path / 'notes.txt'):
        pass
    bag = jazzy_bags.write_bag(tmp_path / 'bag', 'mcap', TOPICS, [make_messages(0, 3)])
    with BagReader(bag) as reader, pytest.raises(DatasetError, match=r'/chatter \(std_msgs/msg'):
        reader.topic('/image')
