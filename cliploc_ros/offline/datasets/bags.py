# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write rosbag2 recordings (sqlite3 and mcap) with the rosbags library.

rosbag2_py is not on PyPI, but recordings are also read and written without ROS. For a fast start
of replay, this module imports little.
"""

import sqlite3
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

from rosbags import interfaces
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import MAKE_ROOM, unfinished

_VISION_MSGS = ('Point2D', 'Pose2D', 'BoundingBox2D', 'ObjectHypothesis',
                'ObjectHypothesisWithPose', 'Detection2D', 'Detection2DArray')
STORAGES: Mapping[str, StoragePlugin] = {'sqlite3': StoragePlugin.SQLITE3,
                                         'mcap': StoragePlugin.MCAP}

#: Greatest share of a topic's messages that may be unusable and left out.
MOST_LEFT_OUT = 0.2
_INFINITE = interfaces.QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE

#: The default of rclcpp, which camera drivers and detectors offer. It matches best-effort and
#: reliable subscribers.
RELIABLE_QOS = interfaces.Qos(
    interfaces.QosHistory.KEEP_LAST, 10, interfaces.QosReliability.RELIABLE,
    interfaces.QosDurability.VOLATILE, _INFINITE, _INFINITE, interfaces.QosLiveliness.AUTOMATIC,
    _INFINITE, False)
#: For maps and static transforms: a late subscriber receives the last message.
LATCHED_QOS = RELIABLE_QOS._replace(depth=1, durability=interfaces.QosDurability.TRANSIENT_LOCAL)


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy's common interfaces, and seven types of vision_msgs.

    All callers share the store: do not register types in it.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = files('cliploc_ros.offline.datasets') / 'vision_msgs' / 'msg'
    for name in _VISION_MSGS:
        definition = (folder / f'{name}.msg').read_text(encoding='utf-8')
        store.register(get_types_from_msg(definition, f'vision_msgs/msg/{name}'))
    return store


def deserialize(data: bytes, msgtype: str, where: str) -> Any:
    """Deserialize a message. DatasetError: the bytes are not a message of this type."""
    try:
        return typestore().deserialize_cdr(data, msgtype)
    except Exception as error:  # the library raises whatever exception the bytes cause
        raise DatasetError(f'{where}: a message is not a valid {msgtype}: {error}') from error


@dataclass(frozen=True)
class BagTopic:
    """A topic of a recording."""

    #: Name and type, such as ``/image`` and ``sensor_msgs/msg/Image``
    name: str
    msgtype: str
    message_count: int  #: Number of messages according to the metadata
    #: QoS of its publishers during the recording; empty if unknown
    offered_qos: tuple[interfaces.Qos, ...] = ()
    type_hash: str = ''  #: RIHS01 hash of the type; empty if not recorded


@dataclass(frozen=True)
class BagMessage:
    """A serialized message of a recording."""

    topic: str  #: Name of the topic
    stamp_ns: int  #: Time of recording [ns]
    data: bytes  #: CDR, with the four-byte header


class BagReader:
    """Reads a rosbag2 folder, or a single .mcap or .db3 file, in order of recording.

    A context manager. It streams messages, so that its memory does not grow with the recording.
    While open, it keeps compressed files (zstd) unpacked in the temporary folder. DatasetError, on
    entry: the recording cannot be read; the message names path and reason.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._reader: Reader  # while it is open
        self.topics: Mapping[str, BagTopic] = {}  #: Topics by name
        #: Reasons and times of unusable messages, by topic
        self.left_out: dict[str, dict[str, None]] = {}
        self.notes: list[str] = []  #: Notes for the user about the recording

    def __enter__(self) -> Self:
        """Open the recording."""
        if not (self.path.is_file() or self.path.is_dir()):
            raise DatasetError(f'{self.path}: no such recording')
        if self.path.is_dir() and not (self.path / 'metadata.yaml').exists():
            raise DatasetError(
                f'{self.path}: has no metadata.yaml; it is not a rosbag2 recording, or it is an '
                f'incomplete one that `ros2 bag reindex {self.path}` repairs'
            )
        try:
            reader = Reader(self.path)
            reader.open()
        except Exception as error:  # from the library, SQLite or the operating system
            raise self._unreadable(error) from error
        self._reader = reader
        try:
            self.topics = self._collect_topics(reader.connections)
        except BaseException:
            reader.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Close the recording."""
        self._reader.close()

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    @property
    def start_ns(self) -> int:
        """Stamp of the first message [ns]; 0 for an empty recording."""
        return self._reader.start_time if self.message_count else 0

    @property
    def end_ns(self) -> int:
        """Stamp of the last message [ns]; 0 for an empty recording."""
        # The library's end lies one nanosecond after the last message.
        return self._reader.end_time - 1 if self.message_count else 0

    def topic(self, name: str) -> BagTopic:
        """Return a topic.

        DatasetError: the recording has no topic of that name; the message lists its topics.
        """
        if name not in self.topics:
            recorded = ', '.join(f'{topic.name} ({topic.msgtype})'
                                 for topic in self.topics.values())
            raise DatasetError(f'{self.path}: has no topic {name}; it has {recorded or "none"}')
        return self.topics[name]

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[BagMessage]:
        """Yield messages in the order of their stamps.

        DatasetError: a topic is unknown, or the recording is damaged.

        Parameters
        ----------
        topics : collection of str, optional
            Names of topics; default: all.
        start_ns, stop_ns : int, optional
            Yield only messages at or after start_ns and before stop_ns [ns].
        """
        names = self.topics if topics is None else topics
        connections = self._connections({self.topic(name).name for name in names})
        if not connections:
            return
        stream = self._reader.messages(connections, start_ns, stop_ns)
        try:
            for connection, stamp_ns, data in stream:
                yield BagMessage(connection.topic, stamp_ns, bytes(data))
        except Exception as error:  # from the library, SQLite or the operating system
            raise self._unreadable(error) from error

    def readable(self, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
        """Yield the topic and object of each message; unreadable messages are left out."""
        for recorded in self.messages(topics):
            try:
                message = self.deserialize(recorded)
            except DatasetError as error:
                self.leave_out(recorded.topic, str(error).removeprefix(f'{self.path}: '))
            else:
                yield recorded.topic, message

    def first(self, topic: str) -> Any:
        """Return the first readable message of a topic; DatasetError: there is none."""
        found = next(self.readable([topic]), None)
        if found is None:
            raise DatasetError(f'{self.path}: {topic} has no readable message')
        return found[1]

    def leave_out(self, topic: str, reason: str) -> None:
        """Count an unusable message; equal reasons of a topic count once.

        DatasetError: the share of unusable messages exceeds MOST_LEFT_OUT.
        """
        reasons = self.left_out.setdefault(topic, {})
        reasons[reason] = None
        if len(reasons) > MOST_LEFT_OUT * self.topic(topic).message_count:
            raise DatasetError(f'{self.path}: {topic}: {len(reasons)} messages cannot be used: '
                               f'{next(iter(reasons))}')

    def left_out_notes(self) -> list[str]:
        """Return a note for each topic with messages that were left out."""
        return [f'{len(reasons)} of {self.topic(topic).message_count} messages of {topic} left '
                f'out: {next(iter(reasons))}' for topic, reasons in self.left_out.items()]

    def deserialize(self, message: BagMessage) -> Any:
        """Deserialize a message into an object with the fields of its type.

        DatasetError: the type is unknown, was recorded with another definition, or does not fit
        the bytes.
        """
        topic = self.topic(message.topic)
        store = typestore()
        if topic.msgtype not in store.types:
            raise DatasetError(f'{self.path}: {topic.name} has an unknown type, {topic.msgtype}')
        if topic.type_hash and topic.type_hash != store.hash_rihs01(topic.msgtype):
            raise DatasetError(
                f'{self.path}: {topic.name} was recorded with a definition of {topic.msgtype} '
                'that differs from that of Jazzy')
        return deserialize(message.data, topic.msgtype,
                           f'{self.path}: {topic.name} at {message.stamp_ns}')

    def _collect_topics(self, connections: Collection[interfaces.Connection]
                        ) -> dict[str, BagTopic]:
        topics: dict[str, BagTopic] = {}
        for connection in connections:
            assert isinstance(connection.ext, interfaces.ConnectionExtRosbag2)
            name, msgtype = connection.topic, connection.msgtype
            known = topics.get(name, BagTopic(name, msgtype, 0))
            if known.msgtype != msgtype:
                raise DatasetError(
                    f'{self.path}: {name} has two types, {known.msgtype} and {msgtype}')
            topics[name] = BagTopic(
                name, msgtype, known.message_count + connection.msgcount,
                known.offered_qos + tuple(connection.ext.offered_qos_profiles),
                known.type_hash or connection.digest)
        return topics

    def _connections(self, names: Collection[str]) -> list[interfaces.Connection]:
        """Return the library's connections of topics, for the recording and each of its files.

        The library silently drops the messages of a file whose QoS differs from that in
        metadata.yaml, and users edit metadata.yaml to repair QoS. The connections of the files
        always match.
        """
        files = getattr(self._reader.storage, 'storages', [])
        return [connection for part in (self._reader, *files) for connection in part.connections
                if connection.topic in names]

    def _unreadable(self, error: Exception) -> DatasetError:
        name = '' if isinstance(error, ReaderError) else f'{type(error).__name__}: '
        return DatasetError(f'{self.path}: cannot be read as a rosbag2 recording: {name}{error}')


class BagWriter:
    """Writes a rosbag2 folder as Jazzy does (metadata version 9).

    A context manager. It builds the recording next to its final path, and moves it there when it
    is complete. If the block raises, nothing remains. DatasetError: the path exists or cannot be
    written, for example because the disk is full.

    Parameters
    ----------
    path : str or Path
        The folder to make. Its parent must exist.
    storage : str
        ``sqlite3`` or ``mcap``.
    """

    def __init__(self, path: str | Path, storage: str = 'sqlite3') -> None:
        self.path = Path(path)
        if storage not in STORAGES:
            raise DatasetError(f'storage {storage!r} is not one of {", ".join(STORAGES)}')
        self._storage = STORAGES[storage]
        self._writer: Writer  # while it is open
        self._connections: dict[str, interfaces.Connection] = {}

    def __enter__(self) -> Self:
        """Begin the recording next to its final path."""
        self._check_free()
        with ExitStack() as begun, self._naming_failures():
            self._staging = begun.enter_context(unfinished(self.path, Path.mkdir))
            self._writer = Writer(self._staging / self.path.name, version=9,
                                  storage_plugin=self._storage)
            begun.callback(self._abort)
            self._writer.open()
            self._removal = begun.pop_all()  # of the folder, at the end
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Complete the recording and move it to its final path, or remove it."""
        with self._removal:
            if kind is None:
                with self._naming_failures():
                    self._writer.close()
                    self._check_free()  # another process may have written it meanwhile
                    (self._staging / self.path.name).rename(self.path)

    def _abort(self) -> None:
        with suppress(Exception):  # the first exception is the one to report
            self._writer.abort()  # does nothing after close

    def add_topic(self, name: str, msgtype: str, qos: interfaces.Qos = RELIABLE_QOS) -> None:
        """Declare a topic before its first message.

        Parameters
        ----------
        name, msgtype : str
            Such as ``/image`` and ``sensor_msgs/msg/Image``.
        qos : Qos
            The QoS that the topic's publisher would offer.
        """
        with self._naming_failures():
            self._connections[name] = self._writer.add_connection(
                name, msgtype, typestore=typestore(), offered_qos_profiles=[qos])

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message, or its CDR bytes, to a declared topic, recorded at a stamp [ns]."""
        connection = self._connections[topic]
        data = (message if isinstance(message, bytes)
                else typestore().serialize_cdr(message, connection.msgtype))
        with self._naming_failures():
            self._writer.write(connection, stamp_ns, data)

    def _check_free(self) -> None:
        if self.path.exists() or self.path.is_symlink():
            raise DatasetError(f'{self.path}: already exists and is not overwritten')
        if not self.path.parent.is_dir():
            raise DatasetError(f'{self.path}: the folder {self.path.parent} does not exist')

    @contextmanager
    def _naming_failures(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error, WriterError) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            raise DatasetError(f'{self.path}: cannot be written: {reason}; no partial file '
                               f'remains: {MAKE_ROOM}') from error
