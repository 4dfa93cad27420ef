# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of one instant, of one camera or several."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from itertools import islice

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

#: A robot that is refused retries at once: discovering its publishers again would cost it a tenth
#: of a second.
LINGER_S = 1.0
# The images of other cameras come at most this much later, or not at all.
_PATIENCE_S = 0.3
# A frame of an instant that was passed on comes at most this much late; time has jumped back else.
_LATE_NS = 5 * NS_PER_S
_MOST_PENDING = 4
_CHECK_PERIOD_S, _REST_PERIOD_S = 0.1, 0.5


class _Instant:
    """Frames of one instant, by camera, while others may come.

    Parameters
    ----------
    first : Frame
        The first one that is complete.
    count : int
        Number of cameras.
    """

    def __init__(self, first: Frame, count: int) -> None:
        self.frames = {first.camera: first}
        self.image_until = first.received_at + _PATIENCE_S
        # a detector that serves the cameras in turn is done with the last one after this time
        self.until = first.detected_at + _PATIENCE_S + count * (
            first.detected_at - first.received_at)

    @property
    def stamps_ns(self) -> list[int]:
        """Return the stamps of its images [ns]."""
        return [frame.stamp_ns for frame in self.frames.values()]

    def take(self, frame: Frame, tolerance_ns: float) -> bool:
        """Take a frame of this instant; return whether it is one."""
        stamps = [*self.stamps_ns, frame.stamp_ns]
        if frame.camera in self.frames or max(stamps) - min(stamps) > tolerance_ns:
            return False
        self.frames[frame.camera] = frame
        return True


class CameraRig:
    """The frames of one camera or several: a source for each, used as one.

    A frame is of the first camera, in the order of the parameter, that has one of the newest
    instant; those of the others are beside it. A camera that is late or silent is left out and
    named. It never blocks a request.

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
        # With several cameras in continuous mode, one that is late or silent delays no other.
        self._is_continuous = linger_s == math.inf and len(self.sources) > 1
        # Simulated time may stand still.
        node.create_timer(_CHECK_PERIOD_S if self._is_continuous else _REST_PERIOD_S, self._tick,
                          MutuallyExclusiveCallbackGroup(),
                          Clock(clock_type=ClockType.STEADY_TIME))

    def open(self) -> None:
        """Allow calls of next_frame; OptionsError: see FrameSource."""
        for source in self.sources.values():
            source.open()

    def close(self, reason: str) -> None:
        """Unsubscribe, and let waiting calls of next_frame raise StoppedError with a reason."""
        for source in self.sources.values():
            source.close(reason)

    def forget(self) -> None:
        """Drop the messages received so far."""
        for source in self.sources.values():
            source.forget()
        with self._changed:
            self._pending.clear()
            self._passed.clear()
            self._passed_ns = -_LATE_NS

    def next_frame(self, after: float, deadline: float, linger_s: float | None = None,
                   cameras: int | None = None) -> Frame:
        """Return the first instant whose images arrived after a moment.

        Both times are of the monotonic clock [s]. `linger_s` takes the place of the rig's own.
        Only the first `cameras` cameras count; None: all of them.

        Raises
        ------
        NoFrameError
            None arrived before the deadline; the message says what was missing.
        StoppedError
            The rig was closed; the message gives the reason.
        """
        sources = dict(islice(self.sources.items(), cameras))
        with self._changed:  # subscribed until the last camera's frame is there
            for source in sources.values():
                source.want(deadline)
            end = deadline
            while True:
                self._pass_on()
                passed = self._fullest(self._passed, after, sources)
                if passed is not None:  # of those that follow one another none lasts
                    end = min(end, passed.received_at + _PATIENCE_S)
                frame = self._fullest([*self._passed, *(one.frames for one in self._pending)],
                                      after, sources)
                left_s = end - time.monotonic()
                if (frame is not None and not frame.left_out) or left_s <= 0.0 or any(
                        source.is_closed for source in sources.values()):
                    break
                # messages may be lost: the next instant may have all cameras
                self._changed.wait(min(left_s, _CHECK_PERIOD_S))
            why = '' if frame else '; '.join(source.why_none(after) for source in sources.values())
            for source in sources.values():
                source.want_no_more(deadline, linger_s)  # which may forget both
        if frame is None:
            raise NoFrameError(f'no fresh frame within {deadline - after:.3g} s: {why}')
        return frame

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report the inputs of each camera."""
        for name, source in self.sources.items():
            own = Health()
            source.examine(own, stale_after_s)
            health.add(own, name)

    def _take(self, frame: Frame) -> None:
        """Take in a frame, and pass on the instants that are complete."""
        with self._changed:
            if self._is_continuous and 0 <= self._passed_ns - frame.stamp_ns < _LATE_NS:
                # too late for its instant; those who wait for a frame may have it
                self._passed.append({frame.camera: frame})
                self._changed.notify_all()
                return
            if not any(one.take(frame, self._tolerance_s * NS_PER_S) for one in self._pending):
                self._pending.append(_Instant(frame, len(self.sources)))
            self._changed.notify_all()
        self._pass_on()

    def _pass_on(self) -> None:
        """Pass on the instants, in their order, that no other frame can complete."""
        with self._changed:  # while passing on, too: the timer must not overtake a frame
            while self._pending and (len(self._pending) > _MOST_PENDING
                                     or not self._may_grow(self._pending[0])):
                instant = self._pending.popleft()
                self._passed.append(instant.frames)
                self._passed_ns = max(instant.stamps_ns)
                self._changed.notify_all()
                self._on_frame(self._joined(instant.frames, self.sources))

    def _may_grow(self, instant: _Instant) -> bool:
        """Return whether a frame of another camera may still come; holds the condition."""
        now, at_ns = time.monotonic(), max(instant.stamps_ns)
        return now < instant.until and any(
            now < instant.image_until or source.awaits_detections(at_ns, self._tolerance_s)
            for name, source in self.sources.items() if name not in instant.frames)

    def _tick(self) -> None:
        """Pass on instants that waited long enough; unsubscribe once no frame is wanted."""
        self._pass_on()
        with self._changed:
            subscribed = [source.rest() for source in self.sources.values()]
            if not any(subscribed):
                self._pending.clear()
                self._passed.clear()

    def _fullest(self, instants: Iterable[Mapping[str, Frame]], after: float,
                 names: Collection[str]) -> Frame | None:
        """Return the instant of the most of some cameras whose images arrived after a moment.

        Of several with as many cameras the newest one: the last of `instants`.
        """
        fullest = max(({name: frame for name, frame in frames.items()
                        if name in names and frame.received_at >= after}
                       for frames in reversed([*instants])),
                      key=len, default={})
        return self._joined(fullest, names) if fullest else None

    def _joined(self, frames: Mapping[str, Frame], names: Collection[str]) -> Frame:
        """Return frames of one instant as the first camera's, with those of others beside it."""
        first, *others = (frames[name] for name in names if name in frames)
        return replace(first, beside=tuple(others),
                       left_out=tuple(name for name in names if name not in frames))
