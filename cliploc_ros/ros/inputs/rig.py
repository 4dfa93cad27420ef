# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one robot: the frames of one instant."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError, TimedImage
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.threads import LatestOnly, Worker
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

# The images of other cameras come at most this much later, or not at all.
_PATIENCE_S = 0.3
# A frame of an instant that was passed on comes at most this much late; time has jumped back else.
_LATE_NS = 5 * NS_PER_S
_MOST_PENDING = 4
_CHECK_PERIOD_S = 0.1


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
        return [_stamp_ns(one) for one in self.frames.values()]

    def take(self, frame: Frame, tolerance_ns: float) -> bool:
        """Take a frame of this instant; return whether it is one."""
        stamps = [*self.stamps_ns, _stamp_ns(frame)]
        if frame.camera in self.frames or max(stamps) - min(stamps) > tolerance_ns:
            return False
        self.frames[frame.camera] = frame
        return True


class Rig:
    """A frame source for each camera; used as one.

    A frame is of the first camera, in the order of the parameter, that has one of the newest
    instant; those of the others are beside it. A camera that is late or silent is left out and
    named. It never blocks a request.

    Parameters
    ----------
    linger_s, on_frame
        See FrameSource.
    """

    def __init__(self, node: Node, parameters: RelocalizerParameters, linger_s: float,
                 on_frame: Callable[[Frame], None]) -> None:
        self._changed = threading.Condition()
        self._tolerance_s = parameters.sync_tolerance_s
        self._on_frame = on_frame
        self._sources = {name: FrameSource(
            node, parameters.image_transport, linger_s, self._take, parameters.detections_type,
            parameters.depth_transport, parameters.depth_tolerance_s, name, self._changed)
            for name in parameters.camera_names}
        self._pending: deque[_Instant] = deque()
        self._passed: deque[Mapping[str, Frame]] = deque(maxlen=_MOST_PENDING)
        self._passed_ns = -_LATE_NS
        self._is_continuous = linger_s == math.inf
        if self._is_continuous:  # a camera that is silent completes no instant
            node.create_timer(_CHECK_PERIOD_S, self._pass_on, MutuallyExclusiveCallbackGroup(),
                              Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def topics(self) -> list[str]:
        """Return the relative names of the topics of all cameras."""
        return [topic for source in self._sources.values() for topic in source.topics]

    @property
    def image_topic(self) -> str:
        """Return the resolved name of the image topic of the first camera."""
        return self.main.image_topic

    @property
    def main(self) -> FrameSource:
        """Return the source of the first camera."""
        return next(iter(self._sources.values()))

    def open(self) -> None:
        """Allow calls of next_frame; OptionsError: see FrameSource."""
        for source in self._sources.values():
            source.open()

    def close(self, reason: str) -> None:
        """Unsubscribe, and let waiting calls of next_frame raise StoppedError with a reason."""
        for source in self._sources.values():
            source.close(reason)

    def forget(self) -> None:
        """Drop the messages received so far."""
        for source in self._sources.values():
            source.forget()
        with self._changed:
            self._pending.clear()
            self._passed.clear()
            self._passed_ns = -_LATE_NS

    def next_frame(self, after: float, deadline: float) -> Frame:
        """Return the first instant whose images arrived after a moment; see FrameSource."""
        sources = list(self._sources.values())
        with self._changed:  # subscribed until the last camera's frame is there
            for source in sources:
                source.want(deadline)
            frame, end = None, deadline
            # messages may be lost: the next instant may have all cameras
            while not self.main.is_closed and (frame is None or frame.left_out) and (
                    left_s := end - time.monotonic()) > 0.0:
                self._changed.wait(min(left_s, _CHECK_PERIOD_S))
                self._pass_on()
                frame = self._fullest(self._passed, after)
                if frame is not None:  # of those that follow one another none lasts
                    end = min(end, frame.received_at + _PATIENCE_S)
            if frame is None:  # the others of an instant cannot come in time
                frame = self._fullest((one.frames for one in self._pending), after)
            why = '' if frame else '; '.join(one.why_none(after) for one in sources)
            for source in sources:
                source.want_no_more(deadline)  # which may forget both
        if frame is None:
            raise NoFrameError(f'no fresh frame within {deadline - after:.3g} s: {why}')
        return frame

    def missing(self) -> list[str]:
        """Return for each input that nothing publishes a line that says what to do."""
        return [line for source in self._sources.values() for line in source.missing()]

    def unheard(self, since: float) -> dict[str, str]:
        """Return the inputs that were silent since a moment, and why; see FrameSource."""
        return {name: why for source in self._sources.values()
                for name, why in source.unheard(since).items()}

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report the inputs of each camera."""
        for name, source in self._sources.items():
            own = Health()
            source.examine(own, stale_after_s)
            health.add(own, name)

    def _take(self, frame: Frame) -> None:
        """Take in a frame, and pass on the instants that are complete."""
        with self._changed:
            if self._is_continuous and 0 <= self._passed_ns - _stamp_ns(frame) < _LATE_NS:
                return
            if not any(one.take(frame, self._tolerance_s * NS_PER_S) for one in self._pending):
                self._pending.append(_Instant(frame, len(self._sources)))
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
                self._on_frame(self._joined(instant.frames))

    def _may_grow(self, instant: _Instant) -> bool:
        """Return whether a frame of another camera may still come; holds the condition."""
        now, at_ns = time.monotonic(), max(instant.stamps_ns)
        return now < instant.until and any(
            now < instant.image_until or source.awaits_detections(at_ns, self._tolerance_s)
            for name, source in self._sources.items() if name not in instant.frames)

    def _fullest(self, instants: Iterable[Mapping[str, Frame]], after: float) -> Frame | None:
        """Return the instant of the most cameras whose images arrived after a moment, or None."""
        fresh = ({name: one for name, one in frames.items() if one.received_at >= after}
                 for frames in instants)
        fullest = max(fresh, key=len, default={})
        return self._joined(fullest) if fullest else None

    def _joined(self, frames: Mapping[str, Frame]) -> Frame:
        """Return frames of one instant as the first camera's, with those of others beside it."""
        first, *others = (frames[name] for name in self._sources if name in frames)
        return replace(first, beside=tuple(others), left_out=tuple(
            name for name in self._sources if name not in frames))


def frames_of(node: Node, parameters: RelocalizerParameters, linger_s: float,
              on_frame: Callable[[Frame], None] = lambda frame: None) -> FrameSource | Rig:
    """Return the source of the frames of one camera or several; see FrameSource."""
    if parameters.camera_names:
        return Rig(node, parameters, linger_s, on_frame)
    return FrameSource(node, parameters.image_transport, linger_s, on_frame,
                       parameters.detections_type, parameters.depth_transport,
                       parameters.depth_tolerance_s)


class NewestInstant:
    """Passes images of several cameras to a worker: one of each, as near in time as they come.

    While the worker is busy, the two newest images of each camera wait: the newest may be of an
    instant that other cameras have not delivered yet.

    Parameters
    ----------
    work : callable
        Takes the name of a camera and an image, in the worker's thread.
    """

    def __init__(self, worker: Worker, work: Callable[[str, TimedImage], None]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[TimedImage]] = {}
        self._signal = LatestOnly(worker, self._take)
        self.dropped = 0

    @property
    def waiting_since(self) -> float | None:
        """Return when the oldest image that waits arrived (monotonic clock) [s]."""
        with self._lock:
            return min((one.received_at for images in self._waiting.values() for one in images),
                       default=None)

    def offer(self, camera: str, image: TimedImage) -> None:
        """Queue an image of a camera."""
        with self._lock:
            images = self._waiting.setdefault(camera, deque())
            images.append(image)
            if len(images) > 2:
                images.popleft()
                self.dropped += 1
        self._signal.offer(camera)

    def _take(self, camera: str) -> None:
        """Work on the newest instant that all cameras with an image have."""
        with self._lock:
            waiting = {name: images for name, images in self._waiting.items() if images}
            newest_ns = min(_image_ns(images[-1]) for images in waiting.values())
            taken = {}
            for name, images in waiting.items():
                taken[name] = min(images, key=lambda one: abs(_image_ns(one) - newest_ns))
                while images.popleft() is not taken[name]:
                    self.dropped += 1
            more = any(waiting.values())
        for name, image in taken.items():
            self._work(name, image)
        if more:
            self._signal.offer(camera)


def _image_ns(image: TimedImage) -> int:
    return stamp_ns(image.msg.header.stamp)


def _stamp_ns(frame: Frame) -> int:
    return stamp_ns(frame.image.header.stamp)
