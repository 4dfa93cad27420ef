# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in the exact format of Jazzy's `ros2 bag record`, assembled by hand.

Nothing here goes through the writer under test or the library beneath it: the tables, the YAML
and the MCAP records are spelled out as rosbag2 0.26 writes them, metadata version 9. They are
crafted, not recorded, since `ros2 bag` is not on PyPI.
"""

import sqlite3
import struct
import zlib
from binascii import crc32
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
from backports import zstd

INFINITE = 'sec: 9223372036', 'nsec: 854775807'


@dataclass(frozen=True)
class Topic:
    """One topic, with QoS as from discovery: history and depth are unknown."""

    name: str
    msgtype: str
    definition: str
    type_hash: str
    reliability: str = 'reliable'
    durability: str = 'volatile'


@dataclass(frozen=True)
class Message:
    topic: str
    stamp_ns: int
    data: bytes


def qos_yaml(topic: Topic) -> str:
    """Return one publisher's QoS as yaml-cpp writes it."""
    lines = [
        '- history: unknown',
        '  depth: 0',
        f'  reliability: {topic.reliability}',
        f'  durability: {topic.durability}',
    ]
    for name in ('deadline', 'lifespan'):
        lines += [f'  {name}:', *(f'    {part}' for part in INFINITE)]
    lines += ['  liveliness: automatic', '  liveliness_lease_duration:']
    lines += [*(f'    {part}' for part in INFINITE), '  avoid_ros_namespace_conventions: false']
    return '\n'.join(lines)


def indent(text: str, spaces: int) -> str:
    return '\n'.join(' ' * spaces + line for line in text.splitlines())


def metadata_yaml(storage: str, topics: list[Topic], files: list[tuple[str, list[Message]]],
                  compression_format: str = '', compression_mode: str = '') -> str:
    """Return metadata.yaml; files are names on disk and their content."""
    everything = [message for _, messages in files for message in messages]
    start, length = time_range(everything)
    lines = [
        'rosbag2_bagfile_information:',
        '  version: 9',
        f'  storage_identifier: {storage}',
        '  duration:',
        f'    nanoseconds: {length}',
        '  starting_time:',
        f'    nanoseconds_since_epoch: {start}',
        f'  message_count: {len(everything)}',
        '  topics_with_message_count:',
    ]
    for topic in topics:
        lines += [
            '    - topic_metadata:',
            f'        name: {topic.name}',
            f'        type: {topic.msgtype}',
            '        serialization_format: cdr',
            '        offered_qos_profiles:',
            indent(qos_yaml(topic), 10),
            f'        type_description_hash: {topic.type_hash}',
            f'      message_count: {sum(one.topic == topic.name for one in everything)}',
        ]
    lines += [
        f'  compression_format: "{compression_format}"',
        f'  compression_mode: "{compression_mode}"',
        '  relative_file_paths:',
        *(f'    - {name}' for name, _ in files),
        '  files:',
    ]
    for name, messages in files:
        start, length = time_range(messages)
        lines += [
            f'    - path: {name.removesuffix(".zstd")}',
            '      starting_time:',
            f'        nanoseconds_since_epoch: {start}',
            '      duration:',
            f'        nanoseconds: {length}',
            f'      message_count: {len(messages)}',
        ]
    return '\n'.join([*lines, '  custom_data: ~', '  ros_distro: jazzy', ''])


def time_range(messages: list[Message]) -> tuple[int, int]:
    stamps = [message.stamp_ns for message in messages]
    return min(stamps), max(stamps) - min(stamps)


def write_bag(folder: Path, storage: str, topics: list[Topic], parts: list[list[Message]],
              compression: str = '', **options) -> Path:
    """Write a recording of one or several files; compression is '', 'FILE' or 'MESSAGE'."""
    folder.mkdir()
    write, suffix = {'sqlite3': (write_db3, 'db3'), 'mcap': (write_mcap, 'mcap')}[storage]
    files = []
    for index, messages in enumerate(parts):
        path = folder / f'{folder.name}_{index}.{suffix}'
        stored = messages
        if compression == 'MESSAGE':
            stored = [
                Message(one.topic, one.stamp_ns, zstd.compress(one.data)) for one in messages
            ]
        write(path, topics, stored, **options)
        name = path.name
        if compression == 'FILE':
            name += '.zstd'
            (folder / name).write_bytes(zstd.compress(path.read_bytes()))
            path.unlink()
        files.append((name, messages))
    compression_format = 'zstd' if compression else ''
    (folder / 'metadata.yaml').write_text(
        metadata_yaml(storage, topics, files, compression_format, compression)
    )
    return folder


def write_db3(path: Path, topics: list[Topic], messages: list[Message]) -> None:
    """A database of rosbag2_storage_sqlite3, schema version 4."""
    connection = sqlite3.connect(path)
    connection.executescript(
        'CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL);'
        'CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,'
        'metadata TEXT NOT NULL);'
        'CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,'
        'serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL,'
        'type_description_hash TEXT NOT NULL);'
        'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY,topic_type TEXT NOT NULL,'
        'encoding TEXT NOT NULL,encoded_message_definition TEXT NOT NULL,'
        'type_description_hash TEXT NOT NULL);'
        'CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,'
        'timestamp INTEGER NOT NULL, data BLOB NOT NULL);'
        'CREATE INDEX timestamp_idx ON messages (timestamp ASC);'
        "INSERT INTO schema (schema_version, ros_distro) VALUES (4, 'jazzy');"
    )
    for topic in topics:
        connection.execute(
            'INSERT INTO topics(name, type, serialization_format, offered_qos_profiles, '
            'type_description_hash) VALUES (?, ?, ?, ?, ?)',
            (topic.name, topic.msgtype, 'cdr', qos_yaml(topic), topic.type_hash),
        )
        connection.execute(
            'INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, '
            'type_description_hash) VALUES (?, ?, ?, ?)',
            (topic.msgtype, 'ros2msg', topic.definition, topic.type_hash),
        )
    ids = {topic.name: index for index, topic in enumerate(topics, start=1)}
    connection.executemany(
        'INSERT INTO messages (timestamp, topic_id, data) VALUES (?, ?, ?)',
        [(one.stamp_ns, ids[one.topic], one.data) for one in messages],
    )
    connection.execute("INSERT INTO metadata (metadata_version, metadata) VALUES (9, '')")
    connection.commit()
    connection.close()


def write_mcap(path: Path, topics: list[Topic], messages: list[Message],
               chunk_compression: str | None = '') -> None:
    """A file of rosbag2_storage_mcap: one chunk, compressed '', 'zstd' or 'lz4'.

    With ``chunk_compression=None`` there are no chunks, as under the preset fastwrite.
    """
    declarations = b''.join(
        schema_record(index, topic) + channel_record(index, topic)
        for index, topic in enumerate(topics, start=1)
    )
    ids = {topic.name: index for index, topic in enumerate(topics, start=1)}
    body, index = bytearray(declarations), {}
    for sequence, one in enumerate(messages):
        index.setdefault(ids[one.topic], []).append((one.stamp_ns, len(body)))
        head = struct.pack('<HIQQ', ids[one.topic], sequence, one.stamp_ns, one.stamp_ns)
        body += record(0x05, head + one.data)
    file = bytearray(b'\x89MCAP0\r\n' + record(0x01, string('ros2') + string('libmcap 1.1.0')))
    chunk_index = b''
    if chunk_compression is None:
        file += body
    else:
        chunk_index = add_chunk(file, bytes(body), index, messages, chunk_compression)
    file += record(0x0F, struct.pack('<I', 0))
    summary_start = len(file)
    counts = {id_: sum(one.topic == name for one in messages) for name, id_ in ids.items()}
    start, length = time_range(messages)
    statistics = struct.pack(
        '<QHIIIIQQ', len(messages), len(topics), len(topics), 0, 0, bool(chunk_index),
        start, start + length,
    ) + sized(b''.join(struct.pack('<HQ', *item) for item in counts.items()))
    file += declarations + record(0x0B, statistics) + chunk_index
    summary_crc = zlib.crc32(b'')  # 0: not given
    file += record(0x02, struct.pack('<QQI', summary_start, 0, summary_crc)) + b'\x89MCAP0\r\n'
    path.write_bytes(file)


def add_chunk(file: bytearray, body: bytes, index: dict[int, list[tuple[int, int]]],
              messages: list[Message], compression: str) -> bytes:
    """Append a chunk and its message indexes; return the record of its index."""
    compress = {'': bytes, 'zstd': zstd.compress, 'lz4': lz4.frame.compress}[compression]
    data = compress(body)
    start, length = time_range(messages)
    offset = len(file)
    file += record(
        0x06,
        struct.pack('<QQQI', start, start + length, len(body), crc32(body))
        + string(compression) + struct.pack('<Q', len(data)) + data,
    )
    chunk_length = len(file) - offset
    offsets = b''
    for channel, entries in index.items():
        offsets += struct.pack('<HQ', channel, len(file))
        listed = b''.join(struct.pack('<QQ', *entry) for entry in entries)
        file += record(0x07, struct.pack('<H', channel) + sized(listed))
    index_length = len(file) - offset - chunk_length
    return record(
        0x08,
        struct.pack('<QQQQ', start, start + length, offset, chunk_length) + sized(offsets)
        + struct.pack('<Q', index_length) + string(compression)
        + struct.pack('<QQ', len(data), len(body)),
    )


def schema_record(index: int, topic: Topic) -> bytes:
    return record(
        0x03,
        struct.pack('<H', index) + string(topic.msgtype) + string('ros2msg')
        + string(topic.definition),
    )


def channel_record(index: int, topic: Topic) -> bytes:
    metadata = string('topic_type_hash') + string(topic.type_hash)
    metadata += string('offered_qos_profiles') + string(qos_yaml(topic))
    return record(
        0x04,
        struct.pack('<HH', index, index) + string(topic.name) + string('cdr') + sized(metadata),
    )


def record(opcode: int, content: bytes) -> bytes:
    return bytes([opcode]) + struct.pack('<Q', len(content)) + content


def string(text: str) -> bytes:
    return sized(text.encode())


def sized(content: bytes) -> bytes:
    return struct.pack('<I', len(content)) + content
