# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of one or several cameras at one instant."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from itertools import islice

from rclpy.node import Node

from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.threads import steady_timer
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

#: Time to stay subscribed after a request: a client retries at once after a refusal, and new
#: discovery of the publishers would take a tenth of a second.
LINGER_S = 1.0
# Longest wait for the images of the other cameras.
_PATIENCE_S = 0.3
# Greatest delay of a frame after the other frames of its instant; a greater one is a time jump.
_LATE_NS = 5 * NS_PER_S
_MOST_PENDING = 4
_CHECK_PERIOD_S, _REST_PERIOD_S = 0.1, 0.5


class _Instant:
    """Frames of one instant, by camera, while frames of other cameras may still arrive.

    Parameters
    ----------
    first : Frame
        The first complete frame.
    count : int
        Number of cameras.
    """

    def __init__(self, first: Frame, count: int) -> None:
        self.frames = {first.camera: first}
        self.image_until = first.received_at + _PATIENCE_S
        # a detector that processes the cameras one after another has then finished the last one
        self.until = first.detected_at + _PATIENCE_S + count * (
            first.detected_at - first.received_at)

    @property
    def stamps_ns(self) -> list[int]:
        """Return the stamps of the images [ns]."""
        return [frame.stamp_ns for frame in self.frames.values()]

    def take(self, frame: Frame, tolerance_ns: float) -> bool:
        """Add a frame if it belongs to this instant; return whether it does."""
        stamps = [*self.stamps_ns, frame.stamp_ns]
        if frame.camera in self.frames or max(stamps) - min(stamps) > tolerance_ns:
            return False
        self.frames[frame.camera] = frame
        return True


class CameraRig:
    """The frames of one or several cameras, each with its own source.

    The frame of an instant is that of its first camera, in the order of the parameter `cameras`;
    it contains the frames of the other cameras as `beside`. A camera that is late or silent is
    listed in `left_out`. It never blocks a request.

    Parameters
    ----------
    linger_s, on_frame
        See FrameSource.
    """

    def __init__(self, node: Node, parameters: RelocalizerParameters, linger_s: float = LINGER_S,
                 on_frame: Callable[[Frame], None] = lambda frame: None) -> None:
        self._changed = threading.Condition()
        self._tolerance_s = parameters.sync_tolerance_s
        self._on_frame = on_frame
        #: Source of each camera, by name; the name of a single camera is empty
        self.sources = {name: FrameSource(node, parameters, linger_s, self._take, name,
                                          self._changed)
                        for name in parameters.camera_names or ('',)}
        self._pending: deque[_Instant] = deque()
        self._passed: deque[Mapping[str, Frame]] = deque(
            maxlen=_MOST_PENDING if len(self.sources) > 1 else 1)
        self._passed_ns = -_LATE_NS
        # With several cameras in continuous mode, a late or silent camera must not delay others.
        self._is_continuous = linger_s == math.inf and len(self.sources) > 1
        steady_timer(node, _CHECK_PERIOD_S if self._is_continuous else _REST_PERIOD_S, self._tick)

    def open(self) -> None:
        """Allow calls of next_frame; OptionsError: see FrameSource."""
        for source in self.sources.values():
            source.open()

    def close(self, reason: str) -> None:
        """Unsubscribe. Waiting calls of next_frame raise StoppedError with the reason."""
        for source in self.sources.values():
            source.close(reason)

    def forget(self) -> None:
        """Drop all received messages."""
        for source in self.sources.values():
            source.forget()
        with self._changed:
            self._pending.clear()
            self._passed.clear()
            self._passed_ns = -_LATE_NS

    def next_frame(self, after: float, deadline: float, linger_s: float | None = None,
                   cameras: int | None = None) -> Frame:
        """Return the first instant whose images arrived after the time `after`.

        Both times are of the monotonic clock [s]. `linger_s` replaces the value of the rig. Only
        the first `cameras` cameras are used; None: all.

        Raises
        ------
        NoFrameError
            No frame arrived before the deadline; the message says what was missing.
        StoppedError
            The rig was closed; the message gives the reason.
        """
        sources = dict(islice(self.sources.items(), cameras))
        with self._changed:  # all cameras stay subscribed until the last frame has arrived
            for source in sources.values():
                source.want(deadline)
            end = deadline
            while True:
                self._pass_on()
                passed = self._fullest(self._passed, after, sources)
                if passed is not None:  # wait only briefly for an instant with more cameras
                    end = min(end, passed.received_at + _PATIENCE_S)
                frame = self._fullest(
                    [*self._passed, *(instant.frames for instant in self._pending)], after,
                    sources)
                left_s = end - time.monotonic()
                if (frame is not None and not frame.left_out) or left_s <= 0.0 or any(
                        source.closed for source in sources.values()):
                    break
                # if messages were lost, the next instant may have all cameras
                self._changed.wait(min(left_s, _CHECK_PERIOD_S))
            why = '' if frame else '; '.join(source.why_none(after) for source in sources.values())
            for source in sources.values():
                source.want_no_more(deadline, linger_s)  # may drop the messages used above
        if frame is None:
            raise NoFrameError(f'no new frame within {deadline - after:.3g} s: {why}')
        return frame

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report the inputs of each camera."""
        for name, source in self.sources.items():
            own = Health()
            source.examine(own, stale_after_s)
            health.add(own, name)

    def _take(self, frame: Frame) -> None:
        """Add a frame, and pass on complete instants."""
        with self._changed:
            if self._is_continuous and 0 <= self._passed_ns - frame.stamp_ns < _LATE_NS:
                # too late for its instant, but next_frame may use it
                self._passed.append({frame.camera: frame})
                self._changed.notify_all()
                return
            if not any(instant.take(frame, self._tolerance_s * NS_PER_S)
                       for instant in self._pending):
                self._pending.append(_Instant(frame, len(self.sources)))
            self._changed.notify_all()
        self._pass_on()

    def _pass_on(self) -> None:
        """Pass on the instants, in order, that no further frame can complete."""
        def may_grow(instant: _Instant) -> bool:
            """Return whether a frame of another camera may still arrive."""
            now, at_ns = time.monotonic(), max(instant.stamps_ns)
            return now < instant.until and any(
                now < instant.image_until or source.awaits_detections(at_ns, self._tolerance_s)
                for name, source in self.sources.items() if name not in instant.frames)
        with self._changed:  # held during the calls, so that the timer cannot change the order
            while self._pending and (len(self._pending) > _MOST_PENDING
                                     or not may_grow(self._pending[0])):
                instant = self._pending.popleft()
                self._passed.append(instant.frames)
                self._passed_ns = max(instant.stamps_ns)
                self._changed.notify_all()
                self._on_frame(self._joined(instant.frames, self.sources))

    def _tick(self) -> None:
        """Pass on instants that waited long enough; unsubscribe when no frame is wanted."""
        self._pass_on()
        with self._changed:
            subscribed = [source.rest() for source in self.sources.values()]
            if not any(subscribed):
                self._pending.clear()
                self._passed.clear()

    def _fullest(self, instants: Iterable[Mapping[str, Frame]], after: float,
                 names: Collection[str]) -> Frame | None:
        """Return the instant with most of the cameras `names`; None without any.

        Only images that arrived after the time `after` are used. Of instants with equally many
        cameras, the newest is returned: the last of `instants`.
        """
        fullest = max(({name: frame for name, frame in frames.items()
                        if name in names and frame.received_at >= after}
                       for frames in reversed([*instants])), key=len, default={})
        return self._joined(fullest, names) if fullest else None

    def _joined(self, frames: Mapping[str, Frame], names: Collection[str]) -> Frame:
        """Return the first camera's frame of an instant, with the other frames as `beside`."""
        first, *others = (frames[name] for name in names if name in frames)
        return replace(first, beside=tuple(others),
                       left_out=tuple(name for name in names if name not in frames))
