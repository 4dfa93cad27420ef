# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publish a recording: the recorded bytes, with the recorded QoS, at the recorded times.

It replaces `ros2 bag play`, which is missing in ROS from PyPI and in the base installation of ROS.
"""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from itertools import chain, islice
from typing import Any

from rclpy import qos
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
from rosgraph_msgs.msg import Clock

from cliploc_ros.command import Interruption
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import bags
from cliploc_ros.offline.datasets.bag_messages import COMPRESSED_IMAGE, IMAGE, ODOMETRY, stamp_ns
from cliploc_ros.units import NS_PER_S

CLOCK_TOPIC = '/clock'
#: Recorded time between two stands: a robot drives a metre or two.
DRIVE_NS = 3 * NS_PER_S
# Period of the messages while the robot stands.
_STAND_NS = NS_PER_S // 5
_POLL_S = 0.02
# Pause between the passes of a loop.
_GAP_S = 0.1
#: Delay after a subscriber appears: it must discover this publisher too, and ROS does not report
#: when it has.
_DISCOVERY_S = 0.2
#: Depth if none was recorded: discovery does not report a publisher's history.
DEFAULT_DEPTH = 10
#: A recorded duration of this or more is infinite. Foxy's Fast DDS wrote exactly this value.
_INFINITE_S = 2**31 - 1


@dataclass(frozen=True)
class PlayOptions:
    """Options of playing a recording."""

    #: Factor of the recorded speed.
    rate: float = 1.0
    #: Start this long after the beginning of the recording.
    start_offset_s: float = 0.0
    #: Play only these topics; None: all.
    topics: Collection[str] | None = None
    #: Topics to leave out.
    exclude: Collection[str] = ()
    #: New names of topics, by recorded name.
    remap: Mapping[str, str] = field(default_factory=dict)
    #: Rate of messages on /clock with the recording's time [Hz of real time]; None: no clock.
    clock_hz: float | None = None
    #: Start again at the end, until stopped.
    loop: bool = False
    #: Let the robot stand for this time after every DRIVE_NS, see with_stands; 0: never.
    stand_s: float = 0.0


class Player:
    """Publishes an open recording; `stop` ends every wait and the playback within milliseconds.

    DatasetError: there is nothing to play, a topic is not recorded, or a type is not installed or
    has another definition.
    """

    def __init__(self, node: Node, reader: bags.BagReader, options: PlayOptions,
                 stop: Interruption) -> None:
        self._reader, self._options, self._stop = reader, options, stop
        self.topics, self.without_type = _select_topics(reader, options)
        self.start_ns = reader.start_ns + round(options.start_offset_s * NS_PER_S)
        self.end_ns = reader.end_ns
        if self.start_ns > self.end_ns:
            raise DatasetError(
                f'{reader.path}: start offset {options.start_offset_s} s is after its end at '
                f'{(reader.end_ns - reader.start_ns) / NS_PER_S:.3f} s')
        self._publishers = {topic.name: create_publisher(
            node, topic, options.remap.get(topic.name, topic.name)) for topic in self.topics}
        self._clock = node.create_publisher(Clock, CLOCK_TOPIC, 10) if options.clock_hz else None

    def wait_for_subscribers(self, topics: Iterable[str], timeout_s: float) -> None:
        """Wait until each topic, given by recorded name, has a subscriber; default: all topics.

        DatasetError: a topic is not played, or has no subscriber in time; the message names it.
        """
        names = list(topics) or list(self._publishers)
        if unknown := [name for name in names if name not in self._publishers]:
            raise DatasetError(f'{unknown[0]} is not among the topics played: '
                               f'{", ".join(self._publishers)}')
        publishers = [self._publishers[name] for name in names]
        deadline = time.monotonic() + timeout_s
        while unmatched := [publisher for publisher in publishers
                            if not publisher.get_subscription_count()]:
            if time.monotonic() >= deadline:
                raise DatasetError(
                    f'no subscriber within {timeout_s:g} s on '
                    f'{", ".join(publisher.topic_name for publisher in unmatched)}')
            if self._stop.wait(_POLL_S):
                return
        self._stop.wait(_DISCOVERY_S)

    def play(self, on_message: Callable[[bags.BagMessage], None] = lambda message: None
             ) -> Counter[str]:
        """Publish the messages, each at its time; return their number by recorded topic.

        `on_message` is called after each. DatasetError: the recording is damaged.
        """
        rate, counts = self._options.rate, self._publish_latched()

        def late_s(stamp_ns: int) -> float:
            """Return the time since a stamp's time, without drift; negative in the future."""
            due_ns = origin_ns + (stamp_ns - self.start_ns) / rate
            return (time.monotonic_ns() - due_ns) / NS_PER_S

        def wait_for(stamp_ns: int) -> bool:
            """Sleep until a stamp's time; return False if stopped before."""
            left_s = -late_s(stamp_ns)
            return not self._stop.wait(left_s) if left_s > 0 else not self._stop.is_set()

        while not self._stop.is_set():
            messages = self._reader.messages(self._publishers, start_ns=self.start_ns)
            if self._options.stand_s:
                messages = with_stands(messages, self._reader.topics, self._options.stand_s)
            # read the first message, so that opening files delays no message
            messages = chain(list(islice(messages, 1)), messages)
            origin_ns = time.monotonic_ns()
            # /clock ticks on a regular grid of real time; without a clock, nothing ticks
            step_ns = max(round(rate * NS_PER_S / (self._options.clock_hz or 1.0)), 1)
            tick_ns = self.start_ns
            for message in messages:
                while self._clock and tick_ns <= message.stamp_ns and wait_for(tick_ns):
                    tick = Clock()
                    tick.clock.sec, tick.clock.nanosec = divmod(tick_ns, NS_PER_S)
                    self._clock.publish(tick)
                    missed = round(late_s(tick_ns) * rate * NS_PER_S) // step_ns  # skipped
                    tick_ns += step_ns * max(missed, 1)
                if not wait_for(message.stamp_ns):
                    break
                self._publishers[message.topic].publish(message.data)
                counts[message.topic] += 1
                on_message(message)
            if not self._options.loop or self._stop.wait(_GAP_S):
                break
        return counts

    def wait_for_acknowledgement(self, timeout_s: float) -> tuple[str, ...]:
        """Wait until all reliable subscribers have acknowledged all messages, or until stopped.

        The middleware resends lost messages only while their publisher exists. Under load, a
        process that ends right after its last message loses that message. Fast DDS requests
        acknowledgements every 3 s. Returns the topics with missing acknowledgements.
        """
        deadline = time.monotonic() + timeout_s
        waiting = list(self._publishers.values())
        while not self._stop.is_set():
            waiting = [publisher for publisher in waiting
                       if not publisher.wait_for_all_acked(Duration())]
            if not waiting or time.monotonic() >= deadline:
                return tuple(publisher.topic_name for publisher in waiting)
            self._stop.wait(_POLL_S)
        return ()

    def _publish_latched(self) -> Counter[str]:
        """Publish latched messages from before the start, which late subscribers would receive."""
        counts: Counter[str] = Counter()
        latched = [topic.name for topic in self.topics if is_latched(topic.offered_qos)]
        if self.start_ns == self._reader.start_ns or not latched:
            return counts
        for message in self._reader.messages(latched, stop_ns=self.start_ns):
            self._publishers[message.topic].publish(message.data)
            counts[message.topic] += 1
        return counts


def with_stands(messages: Iterable[bags.BagMessage], topics: Mapping[str, bags.BagTopic],
                stand_s: float) -> Iterator[bags.BagMessage]:
    """Let the robot of a recording stand for a time, at an image after every DRIVE_NS.

    A robot that drives is not relocalized. While it stands, the newest message of each topic with
    a header, and the newest transform of each coordinate frame, are repeated with new stamps, and
    odometry has no speed. All later messages are later by the time of the stands.

    DatasetError: a message does not fit its type.
    """
    newest: dict[tuple[str, str], Any] = {}
    late_ns, stop_ns, store = 0, 0, bags.typestore()
    for message in messages:
        kind = topics[message.topic].msgtype
        stop_ns = stop_ns or message.stamp_ns + DRIVE_NS
        content = None if kind not in store.types else bags.deserialize(message.data, kind,
                                                                        message.topic)
        stamped = getattr(content, 'transforms', [content] if hasattr(content, 'header') else [])
        for part in stamped:
            _set_stamp(part, stamp_ns(part) + late_ns)
            newest[message.topic, getattr(part, 'child_frame_id', '')] = part
        yield bags.BagMessage(message.topic, message.stamp_ns + late_ns,
                         bytes(store.serialize_cdr(content, kind)) if stamped else message.data)
        if message.stamp_ns < stop_ns or kind not in (IMAGE, COMPRESSED_IMAGE):
            continue
        for _ in range(max(round(stand_s * NS_PER_S / _STAND_NS), 1)):
            late_ns, now_ns = late_ns + _STAND_NS, stamp_ns(content) + _STAND_NS
            for (topic, _child), part in newest.items():
                # cameras are synchronized; the stamps of transforms may be in the future
                kind, is_transform = topics[topic].msgtype, hasattr(part, 'transform')
                _set_stamp(part, stamp_ns(part) + _STAND_NS if is_transform else now_ns)
                if kind == ODOMETRY:
                    for speed in (part.twist.twist.linear, part.twist.twist.angular):
                        speed.x = speed.y = speed.z = 0.0
                whole = store.types[kind](transforms=[part]) if is_transform else part
                yield bags.BagMessage(topic, message.stamp_ns + late_ns,
                                 bytes(store.serialize_cdr(whole, kind)))
        # messages of the time of the image may still follow
        late_ns, stop_ns = late_ns + _STAND_NS, message.stamp_ns + DRIVE_NS


def _set_stamp(message: Any, stamp_ns: int) -> None:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)


def _select_topics(reader: bags.BagReader, options: PlayOptions
                   ) -> tuple[list[bags.BagTopic], list[bags.BagTopic]]:
    """Return the topics to play, and those whose types are not installed.

    DatasetError: a named topic is not recorded, its type is missing, or there is nothing to play.
    """
    names = list(reader.topics) if options.topics is None else list(options.topics)
    for name in (*names, *options.exclude, *options.remap):
        reader.topic(name)
    left_out = set(options.exclude)
    if options.clock_hz:
        left_out.add(CLOCK_TOPIC)  # two clocks would contradict each other
    topics = [reader.topic(name) for name in dict.fromkeys(names) if name not in left_out]
    if not sum(topic.message_count for topic in topics):
        raise DatasetError(f'{reader.path}: holds no messages on the topics to play')
    lacking = []
    for topic in topics:
        try:
            message_class(topic)
        except DatasetError:
            if options.topics is not None:
                raise
            lacking.append(topic)
    playable = [topic for topic in topics if topic not in lacking]
    if not sum(topic.message_count for topic in playable):
        message_class(lacking[0])  # raises an error
    return playable, lacking


def create_publisher(node: Node, topic: bags.BagTopic, name: str) -> Publisher:
    """Make a publisher with the recorded QoS; ROS may still remap its name.

    DatasetError: the type is not installed, or differs from the recorded one.
    """
    publisher: Publisher = node.create_publisher(message_class(topic), name,
                                                 qos_profile(topic.offered_qos))
    if topic.type_hash.startswith('RIHS01_'):  # introduced by Iron
        for endpoint in node.get_publishers_info_by_topic(publisher.topic_name):
            if endpoint.node_name == node.get_name() and str(endpoint.topic_type_hash) not in (
                    topic.type_hash, 'INVALID'):
                raise DatasetError(
                    f'{topic.name} was recorded with a definition of {topic.msgtype} that differs '
                    f'from the installed one; leave it out: `exclude` {topic.name}')
    return publisher


def message_class(topic: bags.BagTopic) -> Any:
    """Return the installed class of a topic's messages.

    DatasetError: the type is not installed; the message names the package.
    """
    package, _, name = topic.msgtype.partition('/')
    namespace, _, name = name.rpartition('/')
    try:
        return getattr(import_module(f'{package}.{namespace or "msg"}'), name)
    except (ImportError, AttributeError):
        raise DatasetError(
            f'{topic.name} needs {topic.msgtype}, but the package {package} with this type is not '
            f'installed or not sourced: apt install ros-jazzy-{package.replace("_", "-")}, or '
            f'leave the topic out: `exclude` {topic.name}') from None


def qos_profile(offered: Collection[Qos]) -> qos.QoSProfile:
    """Return the QoS profile that a topic's publishers offered.

    With several publishers, the strongest reliability and durability are used, which match all
    their subscribers. The default depth of the history is 10.
    """
    if not offered:
        return qos.QoSProfile(depth=DEFAULT_DEPTH)
    first = next(iter(offered))
    best_effort = all(one.reliability == QosReliability.BEST_EFFORT for one in offered)
    keep_all = first.history == QosHistory.KEEP_ALL
    profile = qos.QoSProfile(
        history=qos.HistoryPolicy.KEEP_ALL if keep_all else qos.HistoryPolicy.KEEP_LAST,
        depth=first.depth or DEFAULT_DEPTH,
        reliability=(qos.ReliabilityPolicy.BEST_EFFORT if best_effort
                     else qos.ReliabilityPolicy.RELIABLE),
        durability=(qos.DurabilityPolicy.TRANSIENT_LOCAL if is_latched(offered)
                    else qos.DurabilityPolicy.VOLATILE))
    if first.liveliness == QosLiveliness.MANUAL_BY_TOPIC:
        profile.liveliness = qos.LivelinessPolicy.MANUAL_BY_TOPIC
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        recorded = getattr(first, name)
        if recorded.sec < _INFINITE_S and (recorded.sec or recorded.nsec):
            setattr(profile, name, Duration(seconds=recorded.sec, nanoseconds=recorded.nsec))
    return profile


def is_latched(offered: Collection[Qos]) -> bool:
    """Return whether a recorded publisher kept messages for late subscribers."""
    return any(one.durability == QosDurability.TRANSIENT_LOCAL for one in offered)
