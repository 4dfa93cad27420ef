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


def test_a_bag_that_loops_jumps_back_once_a_round(simulation, jumps):
    simulation.set_time(*(3 * (100.0, 101.0)))
    assert [time.nanoseconds for time in jumps.forgot] == [100 * S, 100 * S]


def test_messages_from_before_a_jump_are_refused(simulation, jumps):
    simulation.set_time(100.0)
    before = time.monotonic()
    simulation.set_time(95.0)
    after = time.monotonic()
    with pytest.raises(TimeJumpError, match=r' 5\.000 s'):
        jumps.check(stamp(99.9), before)
    assert is_refused(jumps, 95.0, before), 'its counterparts may be from before the jump'
    assert is_refused(jumps, 99.9, after + 60.0), 'it waited in the middleware'
    assert not is_refused(jumps, 95.0, after) and not is_refused(jumps, 94.9, after)
    simulation.set_time(99.9)
    assert not is_refused(jumps, 99.9, after), 'time went on'
    simulation.node.set_parameters([Parameter('use_sim_time', value=False)])
    with pytest.raises(TimeJumpError, match='use_sim_time'):
        jumps.check(stamp(99.9), after)
    assert len(jumps.forgot) == 2


def test_stamps_of_a_stream_that_go_back_end_all_streams():
    order = StampOrder()

    def goes_back(*stamps_s, stream='odom'):
        return [order.goes_back(stream, round(stamp_s * S)) for stamp_s in stamps_s]
    assert goes_back(99.0, 100.0, 100.0, 99.5) == [False] * 4, 'two publishers'
    assert goes_back(5.0, 6.0, stream='arm') == [False] * 2, 'each has its own stamps'
    assert goes_back(98.9, 99.0) == [True, False]
    assert goes_back(1.0, stream='arm') == [False], 'one jump is not counted twice'
    order.clear()
    assert goes_back(1.0) == [False]


@pytest.mark.parametrize(('given', 'problem'), [
    (Time(), 'is 0'), (Time(sec=-1, nanosec=5), 'is -1 s'),
    (Time(sec=1, nanosec=2**32 - 1), 'has 4294967295 nanoseconds'), (Time(sec=9, nanosec=S), '')])
def test_a_stamp_that_is_no_time(given, problem):
    assert stamp_problem(given).startswith(problem) and bool(stamp_problem(given)) == bool(problem)


def named(*messages, stamps=None):
    """Feed stamps and contents, .1 s apart; return the reported ones, and the stamps."""
    stamps = stamps or MessageStamps()
    return [stamps.add(stamp(one), content, 500.0 + 0.1 * number)
            for number, (one, content) in enumerate(messages)], stamps


@pytest.mark.parametrize(('messages', 'expected', 'are_own'), [
    ([(1.0, 'a'), (1.1, 'b')], [True, True], False),
    ([(1.0, 'a'), (1.1, 'b'), (1.2, 'c')], [True] * 3, True),
    ([(1.0, 'a'), (1.0, 'a'), (1.1, 'b'), (1.1, 'b'), (1.2, 'c')], [True] * 5, True),  # twice
    ([(1.0, letter) for letter in 'abcd'], [True, False, False, False], False),  # it stands still
    ([(1.0 + row // 2, one) for row, one in enumerate('abcdefgh')], [True] + [False] * 7, False),
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
