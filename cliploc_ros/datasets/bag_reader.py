# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read rosbag2 recordings (sqlite3 and mcap) with the rosbags library.

Not with rosbag2_py, which PyPI lacks: recordings are also read where no ROS is installed.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import Connection, ConnectionExtRosbag2, Qos
from rosbags.rosbag2 import Reader, ReaderError

from cliploc_ros.datasets.bag_types import deserialize, typestore
from cliploc_ros.errors import DatasetError


@dataclass(frozen=True)
class BagTopic:
    """One topic of a recording."""

    #: As ``/image`` and ``sensor_msgs/msg/Image``
    name: str
    msgtype: str
    message_count: int  #: Number of messages that the recording lists
    #: What its publishers offered during the recording; empty if unknown
    offered_qos: tuple[Qos, ...] = ()
    type_hash: str = ''  #: RIHS01 hash of the type; empty if not recorded


@dataclass(frozen=True)
class BagMessage:
    """One recorded message, still serialized."""

    topic: str  #: Name of its topic
    stamp_ns: int  #: When it was recorded [ns]
    data: bytes  #: CDR, with its four-byte header


class BagReader:
    """Reads a rosbag2 folder, or a single .mcap or .db3 file, in order of recording.

    A context manager. It streams messages: memory does not grow with the recording. It unpacks
    compressed files (zstd) into the temporary folder while it is open.

    Raises
    ------
    DatasetError
        On entry, if the recording cannot be read; the message names path and reason.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._reader: Reader | None = None
        self._topics: dict[str, BagTopic] = {}

    def __enter__(self) -> Self:
        """Open the recording."""
        if not self.path.exists():
            raise DatasetError(f'{self.path}: no such recording')
        if self.path.is_dir() and not (self.path / 'metadata.yaml').exists():
            raise DatasetError(
                f'{self.path}: has no metadata.yaml; it is no rosbag2 recording, or an incomplete '
                f'one that `ros2 bag reindex {self.path}` rebuilds'
            )
        try:
            reader = Reader(self.path)
            reader.open()
        except Exception as error:  # the library's own, sqlite's, the operating system's
            raise self._unreadable(error) from error
        self._reader = reader
        try:
            self._topics = self._collect_topics(reader.connections)
        except BaseException:
            reader.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the recording."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    @property
    def topics(self) -> Mapping[str, BagTopic]:
        """Topics by name."""
        return self._topics

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self._topics.values())

    @property
    def start_ns(self) -> int:
        """Stamp of the first message [ns]; 0 for an empty recording."""
        return self._open_reader.start_time if self.message_count else 0

    @property
    def end_ns(self) -> int:
        """Stamp of the last message [ns]; 0 for an empty recording."""
        # The library's end lies one nanosecond after the last message.
        return self._open_reader.end_time - 1 if self.message_count else 0

    def topic(self, name: str) -> BagTopic:
        """Return a topic.

        Raises
        ------
        DatasetError
            If the recording has no topic of that name; the message lists its topics.
        """
        if name not in self._topics:
            recorded = ', '.join(f'{one.name} ({one.msgtype})' for one in self._topics.values())
            raise DatasetError(f'{self.path}: has no topic {name}; it has {recorded or "none"}')
        return self._topics[name]

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[BagMessage]:
        """Yield messages in the order of their stamps.

        Parameters
        ----------
        topics : collection of str, optional
            Names of topics; all of them by default.
        start_ns, stop_ns : int, optional
            Yield only messages at or after start_ns and before stop_ns [ns].

        Raises
        ------
        DatasetError
            For an unknown topic, or at a damaged part of the recording.
        """
        names = self._topics if topics is None else topics
        connections = self._connections({self.topic(name).name for name in names})
        if not connections:
            return
        stream = self._open_reader.messages(connections, start_ns, stop_ns)
        while True:
            try:
                connection, stamp_ns, data = next(stream)
            except StopIteration:
                return
            except Exception as error:  # the library's own, sqlite's, the operating system's
                raise self._unreadable(error) from error
            yield BagMessage(connection.topic, stamp_ns, bytes(data))

    def deserialize(self, message: BagMessage) -> Any:
        """Turn a message's bytes into an object with the fields of its type.

        Raises
        ------
        DatasetError
            If the type is unknown here or was recorded with another definition, or if the
            bytes do not fit it.
        """
        topic = self.topic(message.topic)
        store = typestore()
        if topic.msgtype not in store.types:
            raise DatasetError(f'{self.path}: {topic.name} has an unknown type, {topic.msgtype}')
        if topic.type_hash and topic.type_hash != store.hash_rihs01(topic.msgtype):
            raise DatasetError(
                f'{self.path}: {topic.name} was recorded with another definition of '
                f'{topic.msgtype} than the one of Jazzy')
        return deserialize(message.data, topic.msgtype,
                           f'{self.path}: {topic.name} at {message.stamp_ns}')

    @property
    def _open_reader(self) -> Reader:
        if self._reader is None:
            raise RuntimeError('the recording is not open: use it in a with statement')
        return self._reader

    def _collect_topics(self, connections: Collection[Connection]) -> dict[str, BagTopic]:
        topics: dict[str, BagTopic] = {}
        for one in connections:
            assert isinstance(one.ext, ConnectionExtRosbag2)
            known = topics.get(one.topic, BagTopic(one.topic, one.msgtype, 0))
            if known.msgtype != one.msgtype:
                raise DatasetError(
                    f'{self.path}: {one.topic} has two types, {known.msgtype} and {one.msgtype}')
            topics[one.topic] = BagTopic(
                one.topic, one.msgtype, known.message_count + one.msgcount,
                known.offered_qos + tuple(one.ext.offered_qos_profiles),
                known.type_hash or one.digest)
        return topics

    def _connections(self, names: Collection[str]) -> list[Connection]:
        """Return the library's handles of topics, of the recording and of each of its files.

        The library silently drops the messages of a file whose QoS differs from that in
        metadata.yaml, which people edit to repair QoS. The files' own handles always match.
        """
        reader = self._open_reader
        files = getattr(reader.storage, 'storages', [])
        handles = [*reader.connections, *(one for file in files for one in file.connections)]
        return [handle for handle in handles if handle.topic in names]

    def _unreadable(self, error: Exception) -> DatasetError:
        name = '' if isinstance(error, ReaderError) else f'{type(error).__name__}: '
        return DatasetError(f'{self.path}: cannot be read as a rosbag2 recording: {name}{error}')
