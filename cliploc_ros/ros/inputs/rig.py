# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one robot: the frames of one instant."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from rclpy.node import Node

from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, TimedImage, next_of_any
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.worker import LatestOnly, Worker
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

# The images of other cameras come at most this much later, or not at all.
_PATIENCE_S = 0.3


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

    def next_frame(self, after: float, deadline: float) -> Frame:
        """Return the first instant whose images arrived after a moment; see FrameSource."""
        sources = list(self._sources.values())
        frame = next_of_any(sources, after, deadline)
        begun_at = time.monotonic()
        # a detector that serves the cameras in turn is done with the last one after this time
        in_turn_s = _PATIENCE_S + len(sources) * (frame.detected_at - frame.received_at)

        def is_all(awaited: Callable[[FrameSource], bool]) -> bool:
            return sources[0].is_closed or not any(
                awaited(self._sources[name]) for name in self._instant(frame, after).left_out)
        with self._changed:
            self._changed.wait_for(
                lambda: is_all(lambda source: True),
                max(0.0, min(begun_at + _PATIENCE_S, deadline) - time.monotonic()))
            self._changed.wait_for(
                lambda: is_all(lambda source: source.awaits_detections(
                    _stamp_ns(frame), self._tolerance_s)),
                max(0.0, min(begun_at + in_turn_s, deadline) - time.monotonic()))
            return self._instant(frame, after)

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
        """Pass on an instant with its first camera's frame."""
        with self._changed:
            instant = self._instant(frame, frame.received_at - self._tolerance_s)
        if instant.camera == frame.camera:
            self._on_frame(instant)

    def _instant(self, frame: Frame, after: float) -> Frame:
        """Return the frames of the newest instant, as the first camera's and those beside it."""
        found = {name: newest for name, source in self._sources.items()
                 if (newest := source.newest_since(after)) is not None} or {frame.camera: frame}
        last_ns = max(_stamp_ns(one) for one in found.values())
        near = [one for one in found.values()
                if last_ns - _stamp_ns(one) <= self._tolerance_s * NS_PER_S]
        left_out = tuple(name for name in self._sources if name not in {
            one.camera for one in near})
        return replace(near[0], beside=tuple(near[1:]), left_out=left_out)


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
