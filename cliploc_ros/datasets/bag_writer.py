# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write rosbag2 recordings (sqlite3 and mcap) with the rosbags library.

Not with rosbag2_py, which PyPI lacks: recordings are also written where no ROS is installed.
"""

import shutil
import sqlite3
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from cliploc_ros.datasets.bag_types import typestore
from cliploc_ros.errors import DatasetError

STORAGES: Mapping[str, StoragePlugin] = {'sqlite3': StoragePlugin.SQLITE3,
                                         'mcap': StoragePlugin.MCAP}

_INFINITE = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE

#: The default of rclcpp, as camera drivers and detectors offer it; matches best-effort and
#: reliable subscribers.
RELIABLE_QOS = Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE,
                   _INFINITE, _INFINITE, QosLiveliness.AUTOMATIC, _INFINITE, False)
#: For maps and static transforms: a late subscriber receives the last message.
LATCHED_QOS = RELIABLE_QOS._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)


class BagWriter:
    """Writes a rosbag2 folder as Jazzy does (metadata version 9).

    A context manager. It builds the recording beside its final path and moves it there when it
    is complete. If the block raises, nothing remains.

    Parameters
    ----------
    path : str or Path
        The folder to make. Its parent must exist.
    storage : str
        ``sqlite3`` or ``mcap``.

    Raises
    ------
    DatasetError
        If the path exists or cannot be written, for example because the disk is full.
    """

    def __init__(self, path: str | Path, storage: str = 'sqlite3') -> None:
        self.path = Path(path)
        if storage not in STORAGES:
            raise DatasetError(f'storage {storage!r} is none of {", ".join(STORAGES)}')
        self._storage = STORAGES[storage]
        self._staging: Path | None = None
        self._writer: Writer | None = None
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        """Begin the recording beside its final path."""
        self._check_free()
        try:
            self._staging = Path(tempfile.mkdtemp(
                prefix=f'.{self.path.name}.', suffix='.partial', dir=self.path.parent))
            writer = Writer(self._staging / self.path.name, version=9,
                            storage_plugin=self._storage)
            writer.open()
        except BaseException as error:  # Ctrl-C, too
            self._discard()
            if isinstance(error, OSError | sqlite3.Error | WriterError):
                raise self._unwritable(error) from error
            raise
        self._writer = writer
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Complete the recording and move it to its final path, or remove it."""
        writer, self._writer = self._writer, None
        assert writer is not None and self._staging is not None
        try:
            if kind is None:
                writer.close()
                self._check_free()  # another process may have written it meanwhile
                (self._staging / self.path.name).rename(self.path)
            else:
                with suppress(Exception):  # the block's own exception is the one to report
                    writer.abort()
        except (OSError, sqlite3.Error) as problem:
            with suppress(Exception):
                writer.abort()
            raise self._unwritable(problem) from problem
        finally:
            self._discard()

    def add_topic(self, name: str, msgtype: str, qos: Qos = RELIABLE_QOS) -> None:
        """Declare a topic before its first message.

        Parameters
        ----------
        name, msgtype : str
            As ``/image`` and ``sensor_msgs/msg/Image``.
        qos : Qos
            What its publisher would offer.
        """
        try:
            self._connections[name] = self._open_writer.add_connection(
                name, msgtype, typestore=typestore(), offered_qos_profiles=[qos])
        except (OSError, sqlite3.Error) as error:
            raise self._unwritable(error) from error

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message of a declared topic, or its bytes, as recorded at a stamp [ns]."""
        connection = self._connections[topic]
        data = (message if isinstance(message, bytes)
                else typestore().serialize_cdr(message, connection.msgtype))
        try:
            self._open_writer.write(connection, stamp_ns, data)
        except (OSError, sqlite3.Error) as error:
            raise self._unwritable(error) from error

    @property
    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise RuntimeError('the recording is not open: use it in a with statement')
        return self._writer

    def _check_free(self) -> None:
        if self.path.exists() or self.path.is_symlink():
            raise DatasetError(f'{self.path}: exists already and is not overwritten')
        if not self.path.parent.is_dir():
            raise DatasetError(f'{self.path}: the folder {self.path.parent} does not exist')

    def _discard(self) -> None:
        if self._staging is not None:
            shutil.rmtree(self._staging, ignore_errors=True)
            self._staging = None

    def _unwritable(self, error: Exception) -> DatasetError:
        reason = getattr(error, 'strerror', None) or str(error)
        return DatasetError(f'{self.path}: cannot be written: {reason}; no partial file remains')
