# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A clock that goes back, in simulated time; stamps that are none."""

import time

import pytest
from builtin_interfaces.msg import Time
from frames import stamp
from rclpy.parameter import Parameter
from rclpy.time import Time as RosTime

from cliploc_ros.ros.inputs import stamps as times

S = 1_000_000_000


@pytest.fixture
def node(make_node):
    return make_node(parameter_overrides=[Parameter('use_sim_time', value=True)])


def set_time(node, *moments_s):
    """Set simulated time, as a message on /clock does."""
    for seconds in moments_s:
        node.get_clock().set_ros_time_override(RosTime(nanoseconds=round(seconds * S)))


def is_refused(jumps, stamp_s, received_at):
    try:
        jumps.check(stamp(stamp_s), received_at)
    except times.TimeJumpError:
        return True
    return False


def test_messages_from_before_a_jump_are_refused(node):
    forgot = []
    jumps = times.TimeJumps(node, lambda: forgot.append(node.get_clock().now().nanoseconds))
    set_time(node, *(3 * (100.0, 101.0)), 102.0)
    assert forgot == [100 * S, 100 * S], 'a bag that loops jumps back once a round'
    before = time.monotonic()
    set_time(node, 97.0)
    after = time.monotonic()
    with pytest.raises(times.TimeJumpError, match=r' 5\.000 s'):
        jumps.check(stamp(101.9), before)
    assert is_refused(jumps, 97.0, before), 'its counterparts may be from before the jump'
    assert is_refused(jumps, 101.9, after + 60.0), 'it waited in the middleware'
    assert not is_refused(jumps, 97.0, after) and not is_refused(jumps, 96.9, after)
    set_time(node, 101.9)
    assert not is_refused(jumps, 101.9, after), 'time went on'
    node.set_parameters([Parameter('use_sim_time', value=False)])
    with pytest.raises(times.TimeJumpError, match='use_sim_time'):
        jumps.check(stamp(101.9), after)
    assert len(forgot) == 4


def test_stamps_of_a_stream_that_go_back_end_all_streams():
    order = times.StampOrder()

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
    found = times.stamp_problem(given)
    assert found.startswith(problem) and bool(found) == bool(problem)


def named(*messages, stamps=None):
    """Feed stamps and contents, .1 s apart; return the reported ones, and the stamps."""
    stamps = stamps or times.MessageStamps()
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
