# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A clock that goes back: a real /clock, and nodes in simulated time."""

import time

import pytest
from builtin_interfaces.msg import Time
from handing_over import stamp
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from cliploc_ros.ros.inputs.stamps import (
    MessageStamps,
    StampOrder,
    TimeJumpError,
    TimeJumps,
    stamp_problem,
)

S = 1_000_000_000


class Simulation:
    """A node in simulated time, and a publisher of /clock."""

    def __init__(self, make_node, spin_until):
        self.node = make_node(parameter_overrides=[Parameter('use_sim_time', value=True)])
        self.world = make_node('world')
        self._clock = self.world.create_publisher(Clock, '/clock', 10)
        self._spin_until = spin_until

    def spin_until(self, condition, what, work=lambda: None):
        self._spin_until([self.node, self.world], condition, what, work)

    def set_time(self, *moments):
        """Publish each time [s] until the node's clock has it."""
        for seconds in moments:
            message = Clock(clock=stamp(seconds))
            self.spin_until(lambda m=message: self.node.get_clock().now().to_msg() == m.clock,
                            f'{seconds} s', lambda m=message: self._clock.publish(m))


@pytest.fixture
def simulation(make_node, spin_until):
    return Simulation(make_node, spin_until)


@pytest.fixture
def jumps(simulation):
    """Watch the simulated clock; the attribute forgot counts."""
    forgot = []
    jumps = TimeJumps(simulation.node, lambda: forgot.append(simulation.node.get_clock().now()))
    jumps.forgot = forgot
    return jumps


def is_refused(jumps, stamp_s, received_at):
    try:
        jumps.check(stamp(stamp_s), received_at)
    except TimeJumpError:
        return True
    return False


@pytest.mark.parametrize(('moments_s', 'jumps_s'), [
    ((100.0, 95.0, 95.01, 96.0), [95.0]), ((10.0, 9.9, 9.91, 10.9), [9.9]),
    (3 * (100.0, 101.0), [100.0, 100.0])])  # a bag that loops
def test_each_jump_back_is_seen_once(simulation, jumps, moments_s, jumps_s):
    simulation.set_time(*moments_s)
    assert [time.nanoseconds for time in jumps.forgot] == [round(jump_s * S) for jump_s in jumps_s]


def test_messages_from_before_a_jump_are_refused(simulation, jumps):
    simulation.set_time(100.0)
    before = time.monotonic()
    simulation.set_time(95.0)
    after = time.monotonic()
    with pytest.raises(TimeJumpError, match=r' 5\.000 s'):
        jumps.check(stamp(99.9), before)
    assert is_refused(jumps, 95.0, before), 'its counterparts may be from before the jump'
    assert is_refused(jumps, 99.9, after), 'it waited in the middleware'
    assert not is_refused(jumps, 95.0, after) and not is_refused(jumps, 94.9, after)
    assert is_refused(jumps, 99.9, after + 60.0), 'it waited for a long time'
    simulation.set_time(99.9)
    assert not is_refused(jumps, 99.9, after), 'time went on'


def test_the_last_of_two_jumps_counts(simulation, jumps):
    simulation.set_time(100.0, 50.0)
    between = time.monotonic()
    simulation.set_time(20.0)
    assert is_refused(jumps, 50.0, between)
    assert not is_refused(jumps, 20.0, time.monotonic())


def test_a_node_that_leaves_or_enters_simulated_time_forgets(simulation, jumps):
    simulation.set_time(5.0)
    for number, simulated in enumerate((False, True), 1):
        before = time.monotonic()
        simulation.node.set_parameters([Parameter('use_sim_time', value=simulated)])
        assert len(jumps.forgot) == number
        with pytest.raises(TimeJumpError, match='use_sim_time'):
            jumps.check(stamp(5.0), before)
        assert not is_refused(jumps, 5.0, time.monotonic())
    assert is_refused(jumps, 9.0, time.monotonic())


def order_of(*stamps_s, order=None, stream='camera'):
    order = order or StampOrder()
    return [order.goes_back(stream, round(stamp_s * S)) for stamp_s in stamps_s]


@pytest.mark.parametrize(('stamps_s', 'expected'), [
    ((1.0, 2.0, 2.0, 50.0), [False] * 4),
    ((10.0, 9.5, 10.1), [False] * 3),  # two publishers
    ((10.0, 8.9, 9.0, 10.2), [False, True, False, False]),
    ((600.0, 2.0, 1.5, 600.0, 2.0), [False, True, False, False, True])])
def test_stamps_of_a_stream_that_go_back(stamps_s, expected):
    assert order_of(*stamps_s) == expected


def test_streams_have_stamps_of_their_own_until_one_jumps():
    order = StampOrder()
    assert order_of(100.0, order=order, stream='odom') == [False]
    assert order_of(5.0, 6.0, order=order, stream='arm') == [False, False]
    assert order_of(50.0, order=order, stream='odom') == [True]
    # One jump resets all of them: it is not counted twice.
    assert order_of(1.0, order=order, stream='arm') == [False]
    order.clear()
    assert order_of(1.0, order=order, stream='odom') == [False]


@pytest.mark.parametrize(('given', 'problem'), [
    (Time(), 'is 0'), (Time(sec=-1, nanosec=5), 'is -1 s, before 1970'),
    (Time(sec=1, nanosec=2**32 - 1), 'has 4294967295 nanoseconds (limit 999999999)'),
    (Time(nanosec=1), ''), (Time(sec=2**31 - 1), ''), (Time(sec=9, nanosec=S), '')])
def test_a_stamp_that_is_no_time(given, problem):
    assert stamp_problem(given) == problem


def named(*messages, stamps=None):
    """Feed stamps and contents, .1 s apart; return the reported ones, and the stamps."""
    stamps = stamps or MessageStamps()
    return [stamps.add(stamp(one), content, 500.0 + 0.1 * number)
            for number, (one, content) in enumerate(messages)], stamps


@pytest.mark.parametrize(('messages', 'expected', 'are_own'), [
    ([(1.0, 'a'), (1.1, 'b')], [True, True], False),
    ([(1.0, 'a'), (1.1, 'b'), (1.2, 'c')], [True] * 3, True),
    ([(1.1, 'a'), (1.0, 'b'), (1.2, 'c')], [True] * 3, True),  # out of order
    ([(1.0, 'a'), (1.0, 'a'), (1.1, 'b'), (1.1, 'b'), (1.2, 'c')], [True] * 5, True),  # twice
    ([(1.0, letter) for letter in 'abcd'], [True, False, False, False], False),  # it stands still
    ([(1.0 + row // 2, one) for row, one in enumerate('abcdefgh')], [True] + [False] * 7, False),
    ([(0.0, letter) for letter in 'abc'], [False] * 3, False),
    ([(0.0, 'a'), (1.0, 'b'), (1.1, 'c'), (1.2, 'd')], [False, False, False, True], True),
    ([(1.0, 'a'), (1.0, 'a'), (1.0, 'b'), (1.0, 'b')], [True, True, False, True], False),
    ([(1.0, 'a'), (1.1, 'b'), (1.2, 'c'), (900.0, 'd')], [True] * 4, False)])  # another clock
def test_stamps_name_messages_that_have_each_its_own(messages, expected, are_own):
    found, stamps = named(*messages)
    assert found == expected
    assert stamps.are_own == are_own
    assert bool(stamps.problem) == (not expected[-1])


def test_a_message_that_comes_again_is_one():
    _, stamps = named((1.0, 'a'), (1.1, 'b'), (1.0, 'a'))
    assert stamps.is_repeated(S) and not stamps.is_repeated(S + S // 10)
    stamps.clear()
    assert not stamps.is_repeated(S)
    assert named((1.0, 'b'), stamps=stamps)[0] == [True]
