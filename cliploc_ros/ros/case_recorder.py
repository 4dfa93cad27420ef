# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keeps the queries of the last request, and stores them as a case when that is asked for."""

import threading
from collections import deque
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cliploc_ros.core.query import CASE, Case, Query, case_arrays
from cliploc_ros.errors import CliplocError, DatasetError, OptionsError
from cliploc_ros.ros.answer import Answer, Verdict
from cliploc_ros.ros.parameters import RelocalizerParameters

# As many frames as acceptance looks back to, see cliploc_ros.core.acceptance.looks.
_MAX_FRAMES = 20
_MAX_BYTES = 256 * 2**20
_MIB = 2**20
_LIBRARIES = ('cliploc_ros', 'numpy', 'scipy', 'numba')


class NoCaseError(CliplocError):
    """There is nothing to record; the message says why."""


class CaseRecorder:
    """The last answers to frames of requests, if it keeps any; older ones are forgotten."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._lock = threading.Lock()
        self._seen: deque[Answer] = deque(maxlen=_MAX_FRAMES)
        self._last = Answer(Verdict.FAILED, 'no request yet')

    def add(self, answer: Answer) -> None:
        """Keep what was found in a frame."""
        if not self._keeps:
            return
        with self._lock:
            self._seen.append(answer)
            while sum(map(_bytes, self._seen)) > _MAX_BYTES \
                    and len(self._seen) > 1:
                self._seen.popleft()

    def end(self, answer: Answer) -> None:
        """Keep the answer of a request."""
        with self._lock:
            self._last = answer

    def forget(self) -> None:
        """Forget all frames."""
        with self._lock:
            self._seen.clear()

    def store(self, parameters: RelocalizerParameters) -> str:
        """Store the last request in record_folder; return what was stored, in one line.

        Raises
        ------
        NoCaseError
            No request, or none that saw a frame.
        CliplocError
            The folder is not given, full, or cannot be written.
        """
        if not parameters.record_folder:
            raise OptionsError('record_folder is empty: set it at the start, to a folder with '
                               'room for record_limit_mb')
        queries, found, last = self._linked()
        folder, versions = _made_folder(parameters.record_folder), {}
        for name in _LIBRARIES:
            with suppress(PackageNotFoundError):
                versions[name] = version(name)
        arrays = case_arrays(Case(queries, {
            'verdict': last.verdict, 'message': last.message, 'found': found.verdict,
            'reason': found.detail, 'map_hash': found.map_hash,
            'parameters': asdict(parameters), 'options': asdict(parameters.options()),
            'versions': versions}))
        _check_room(folder, sum(one.nbytes for one in arrays.values()),
                    parameters.record_limit_mb)
        now = datetime.now(UTC).strftime('%Y%m%dT%H%M%S.%f')[:-3]
        path = folder / f'case_{now}_{last.verdict}.npz'
        CASE.write(path, arrays, compress=True)
        return f'{path}: {len(queries)} frames; {last.message}'

    def _linked(self) -> tuple[tuple[Query, ...], Answer, Answer]:
        """Return the queries that the last answer may rest on, the oldest first, and answers.

        Odometry links a frame to those before it. Without it a frame stands alone. The answers
        are that to the newest frame, and that to the request.
        """
        with self._lock:
            seen, last = list(self._seen), self._last
        while seen and seen[-1].received_at != last.received_at:
            seen.pop()
        if not seen:
            raise NoCaseError(f'nothing to record: the last request saw no frame: {last.message}')
        linked: list[Query] = []
        for one in reversed(seen):
            assert one.query is not None
            if linked and (one.query.run is None or one.query.run != linked[0].run):
                break
            linked.insert(0, one.query)
        return tuple(linked), seen[-1], last


def _bytes(answer: Answer) -> int:
    """Return the memory of its images."""
    return 0 if answer.query is None else sum(one.nbytes for one in answer.query.images)


def _made_folder(name: str) -> Path:
    try:
        folder = Path(name).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f'record_folder: {name}: {error.strerror}') from error
    except RuntimeError as error:
        raise DatasetError(f'record_folder: {name}: {error}') from error
    return folder


def _check_room(folder: Path, size: int, limit_mb: int) -> None:
    """Raise unless a size [bytes] fits into what the recordings of the folder may take."""
    # The size of all files; some may be moved away meanwhile.
    used = 0
    for parent, _, names in folder.walk():
        for name in names:
            with suppress(FileNotFoundError):
                used += (parent / name).stat().st_size
    if used + size > limit_mb * _MIB:
        raise DatasetError(f'{folder} holds {used // _MIB} MiB, this case would take '
                           f'{max(1, size // _MIB)} MiB more, record_limit_mb is {limit_mb}: move '
                           'recordings away, or raise it')
