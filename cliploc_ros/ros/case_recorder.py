# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keeps the frames of the last request, and stores them as a recording when that is asked for."""

import threading
from collections import deque
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import CliplocError, DatasetError, OptionsError
from cliploc_ros.messages import detections_from_msg
from cliploc_ros.ros.answer import Answer, Verdict
from cliploc_ros.ros.conversions import detections_to_msg, stamp_ns
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState
from cliploc_ros.ros.parameters import RelocalizerParameters

if TYPE_CHECKING:
    from cliploc_ros.offline.datasets.cases import Case, CaseFrame

# As many frames as acceptance looks back to, see cliploc_ros.core.acceptance.looks.
_MAX_FRAMES = 20
_MAX_BYTES = 256 * 2**20
_MIB = 2**20


class NoCaseError(CliplocError):
    """There is nothing to record; the message says why."""


class _Seen(NamedTuple):
    frame: Frame
    answer: Answer


class CaseRecorder:
    """The last frames that requests looked at, if it keeps any; older ones are forgotten."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._lock = threading.Lock()
        self._seen: deque[_Seen] = deque(maxlen=_MAX_FRAMES)
        self._last = Answer(Verdict.FAILED, 'no request yet')

    def add(self, frame: Frame, answer: Answer) -> None:
        """Keep a frame and what was found in it."""
        if not self._keeps:
            return
        with self._lock:
            self._seen.append(_Seen(frame, answer))
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
        try:
            from cliploc_ros.offline.datasets.cases import Case, write_case
        except ImportError as error:
            raise OptionsError(f'recording needs rosbags ({error}): pip install rosbags'
                               ) from error
        seen, last = self._linked()
        folder = _made_folder(parameters.record_folder)
        found = seen[-1].answer
        case = Case(tuple(frame for one in seen for frame in _case_frames(one)), {
            'verdict': str(last.verdict), 'message': last.message, 'found': str(found.verdict),
            'reason': found.detail, 'map_hash': found.map_hash, 'linked': found.is_linked,
            'cameras_before': found.cameras_before.fields() if found.cameras_before else {},
            'parameters': asdict(parameters), 'options': asdict(parameters.options())})
        _check_room(folder, case, parameters.record_limit_mb)
        now = datetime.now(UTC).strftime('%Y%m%dT%H%M%S.%f')[:-3]
        path = folder / f'case_{now}_{last.verdict}'
        write_case(path, case)
        return f'{path}: {len(case.frames)} frames; {last.message}'

    def _linked(self) -> tuple[list[_Seen], Answer]:
        """Return the frames that the last answer may rest on, the oldest first, and the answer.

        Odometry links a frame to those before it. Without it a frame stands alone.
        """
        with self._lock:
            seen, last = list(self._seen), self._last
        newest = next((place for place in reversed(range(len(seen)))
                       if seen[place].frame.received_at == last.received_at), None)
        if newest is None:
            raise NoCaseError(f'nothing to record: the last request saw no frame: {last.message}')
        oldest = newest
        while oldest > 0 and _run(seen[newest]) is not None \
                and _run(seen[oldest - 1]) == _run(seen[newest]):
            oldest -= 1
        return seen[oldest:newest + 1], last


def _bytes(seen: _Seen) -> int:
    """Return the memory of its images."""
    return sum(len(image.data) for one in (seen.frame, *seen.frame.beside)
               for image in (one.image, one.depth) if image is not None)


def _run(seen: _Seen) -> int | None:
    """Return the run of odometry that places a frame; None without one."""
    state = seen.answer.state
    return None if state is None or state.place is None else state.place.run


def _case_frames(seen: _Seen) -> list['CaseFrame']:
    """Return the frames of an instant, that of the pose last."""
    return [*(replace(_case_frame(frame, state), is_beside=True)
              for frame, state in seen.answer.beside), _case_frame(seen.frame, seen.answer.state)]


def _case_frame(frame: Frame, state: RobotState | None) -> 'CaseFrame':
    from cliploc_ros.offline.datasets.cases import CaseFrame

    detections, odom_from_camera = frame.detections, None
    if any(one.bbox.center.theta != 0.0 for one in detections.detections):
        # only rclpy's reader understands turned boxes
        detections = detections_to_msg(detections_from_msg(detections), detections.header)
    if state is not None and state.place is not None:
        odom_from_camera = state.place.odom_from_camera
    elif state is not None and frame.camera:
        odom_from_camera = invert_transform(state.camera_from_base)
    return CaseFrame(
        stamp_ns(frame.image.header.stamp), _type_of(frame.image),
        image=bytes(serialize_message(frame.image)),
        camera_info=bytes(serialize_message(frame.camera_info)),
        detections=bytes(serialize_message(detections)),
        up_in_camera=None if state is None else state.up_in_camera,
        odom_from_camera=odom_from_camera, camera=frame.camera,
        depth_type=_type_of(frame.depth) if frame.depth else '',
        depth=bytes(serialize_message(frame.depth)) if frame.depth else b'',
        depth_camera_info=bytes(serialize_message(frame.depth_camera_info))
        if frame.depth_camera_info else b'',
        camera_from_depth=None if state is None else state.camera_from_depth)


def _type_of(image: Image | CompressedImage) -> str:
    return f'sensor_msgs/msg/{type(image).__name__}'


def _made_folder(name: str) -> Path:
    try:
        folder = Path(name).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f'record_folder: {name}: {error.strerror}') from error
    except RuntimeError as error:
        raise DatasetError(f'record_folder: {name}: {error}') from error
    return folder


def _check_room(folder: Path, case: 'Case', limit_mb: int) -> None:
    """Raise unless the case fits into what the recordings of the folder may take."""
    size = sum(len(frame.image) + len(frame.camera_info) + len(frame.detections)
               + len(frame.depth) for frame in case.frames)
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
