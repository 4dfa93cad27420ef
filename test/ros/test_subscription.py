# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import threading
import time
from contextlib import suppress

import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

from cliploc_ros.ros.qos import AdaptiveSubscription

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
DEPTH_ONE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                       reliability=ReliabilityPolicy.BEST_EFFORT,
                       durability=DurabilityPolicy.VOLATILE)


class Ear:
    """An AdaptiveSubscription, the available publishers, and the received messages."""

    def __init__(self, listener, speaker, spin_until, topic='~/topic'):
        self._listener, self._speaker, self._spin_until = listener, speaker, spin_until
        self.topic = listener.resolve_topic_name(topic)
        self.heard = []
        self.subscription = AdaptiveSubscription(listener, Header, topic, self.heard.append,
                                                 DEPTH_ONE)

    def offer(self, reliability):
        return self._speaker.create_publisher(
            Header, self.topic, QoSProfile(depth=10, reliability=reliability))

    def endpoints(self):
        """Return the identity of every subscription, as the publishers' node sees it."""
        return [bytes(info.endpoint_gid) for info in
                self._speaker.get_subscriptions_info_by_topic(self.topic)]

    def policies(self):
        """Return the reliability of every subscription, as the publishers' node sees it."""
        return [info.qos_profile.reliability for info in
                self._speaker.get_subscriptions_info_by_topic(self.topic)]

    def wait_for_policies(self, *policies):
        self.wait(lambda: self.policies() == list(policies),
                  f'{[policy.name for policy in policies]} as the set of subscriptions')

    def wait_for_hearing(self, publisher, name):
        def heard():
            return any(msg.frame_id == name for msg in self.heard)
        self.wait(heard, f'a message of {name}', lambda: publisher.publish(Header(frame_id=name)))

    def wait(self, condition, what, work=lambda: None):
        self._spin_until([self._listener, self._speaker], condition, what, work)


@pytest.fixture
def ear(make_node, spin_until):
    ear = Ear(make_node('listener'), make_node('speaker'), spin_until)
    yield ear
    ear.subscription.destroy()


def test_a_best_effort_publisher_beside_a_reliable_one_is_heard(ear):
    reliable = ear.offer(RELIABLE)
    ear.wait_for_policies(RELIABLE)
    best_effort = ear.offer(BEST_EFFORT)
    ear.wait_for_policies(BEST_EFFORT)
    ear.wait_for_hearing(best_effort, 'best effort')
    ear.wait_for_hearing(reliable, 'reliable')
    for publisher in (best_effort, reliable):  # their process dies, and another one is started
        ear._speaker.destroy_publisher(publisher)
    ear.wait_for_hearing(ear.offer(RELIABLE), 'another')
    ear.wait_for_policies(RELIABLE)


@pytest.mark.filterwarnings('ignore:MultiThreadedExecutor is used with a single thread')
def test_an_event_that_comes_too_late_blocks_nothing_else(ear, context, wait):
    """The subscription is destroyed before its event is handled, which fails in rclpy."""
    listener, executor = ear._listener, MultiThreadedExecutor(1, context=context)
    busy, release, beside = threading.Event(), threading.Event(), []

    def block():
        timer.cancel()
        busy.set()
        release.wait()
    timer = listener.create_timer(0.0, block, MutuallyExclusiveCallbackGroup())
    listener.create_subscription(Header, ear.topic, beside.append, DEPTH_ONE)
    executor.add_node(listener)

    def spin():
        with suppress(InvalidHandle):  # as the nodes' processes do
            executor.spin_once(timeout_sec=0.01)
    wait(busy.is_set, 'the only thread to be busy', spin)
    publisher = ear.offer(RELIABLE)
    for _ in range(20):
        spin()  # the discovery of the publisher is an event, and waits for the thread
    ear.subscription.destroy()
    release.set()

    def work():
        publisher.publish(Header(frame_id='after'))
        spin()
    wait(lambda: beside, 'a message of the other subscription', work)
    executor.shutdown()


def test_empty_messages_make_it_subscribe_again_but_not_all_the_time(ear):
    """Fast DDS delivers an image as an empty message if it was in transit during discovery."""
    publisher = ear.offer(RELIABLE)
    ear.wait_for_hearing(publisher, 'before')
    seen, end = set(ear.endpoints()), time.monotonic() + 2.0

    def publish():
        publisher.publish(b'')
        seen.update(ear.endpoints())
    ear.wait(lambda: time.monotonic() > end, 'two seconds', publish)
    assert 2 <= len(seen) <= 4  # once a second
    ear.wait_for_policies(RELIABLE)
    ear.wait_for_hearing(publisher, 'after')


def test_destroyed_it_hears_nobody_and_stays_away(ear):
    publisher = ear.offer(RELIABLE)
    ear.wait_for_hearing(publisher, 'camera')
    ear.subscription.destroy()
    ear.subscription.destroy()
    ear.wait_for_policies()
    ear.offer(BEST_EFFORT)
    ear.wait(lambda: len(ear._listener.get_publishers_info_by_topic(ear.topic)) == 2,
             'the other publisher')
    assert ear.policies() == []


@pytest.mark.parametrize('overridden', [RELIABLE, BEST_EFFORT])
def test_a_users_override_holds_against_all_publishers(make_node, spin_until, overridden):
    listener = make_node(
        'listener', automatically_declare_parameters_from_overrides=True, parameter_overrides=[
            Parameter('qos_overrides./listener/topic.subscription.reliability',
                      value=overridden.name.lower())])
    ear = Ear(listener, make_node('speaker'), spin_until)
    for number, policy in enumerate((overridden, RELIABLE, BEST_EFFORT), start=1):
        publisher = ear.offer(policy)
        ear.wait(lambda n=number: len(listener.get_publishers_info_by_topic(ear.topic)) == n,
                 'the publisher')
        if overridden == BEST_EFFORT or policy == RELIABLE:
            ear.wait_for_hearing(publisher, f'{number}')
        ear.wait_for_policies(overridden)
    ear.subscription.destroy()
