# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable wake_up with a real relocalizer and, if nav2_msgs is installed, real `spin`."""

import math
import re
import signal

import numpy as np
import pytest
from processes import wait_for
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from scene import make_room, see_room
from tester import make_frame

ACCEPTED, REFUSED, NOT_READY, INTERRUPTED = 0, 1, 2, 130
LOOK = (r'^look (\d+) \[[0-9.]+ s\](, (?:not )?turned by .*?)?: '
        r'((?:accepted|refused|withheld): .*)$')


def looks(process):
    """Parse the output of each look: its number, the turn before it, and the answer."""
    return [(int(number), turned, answer) for number, turned, answer in re.findall(
        LOOK, process.output(), re.MULTILINE)]


def poor_frame():
    """Return a frame with two objects: too few for a pose."""
    return make_frame(see_room(make_room()).select(np.array([0, 1])))


@pytest.fixture
def end(tester):
    """Publish frames until a wake-up has ended; return its exit code."""
    def run(process, frame=lambda: ()):
        def work():
            tester.publish(frame())
            tester.spin()
        wait_for(lambda: not process.alive, 'the end of the wake-up', work=work)
        print(process.output())
        return process.stop()[0]
    return run


class Spinner:
    """A server of Nav2's spin; its robot sees no objects before it has turned far enough.

    Each goal takes the next of the outcomes: 'turn', 'collide', 'refuse' or 'hang' until it is
    cancelled; the last one repeats.
    """

    def __init__(self, tester, *outcomes):
        from nav2_msgs.action import Spin
        self._spin, self._outcomes = Spin, list(outcomes)
        self.yaw, self.goals, self.cancelled = 0.0, [], Future()
        self.server = ActionServer(tester, Spin, 'spin', self._execute, goal_callback=self._take,
                                   cancel_callback=self._cancel)

    def _take(self, goal):
        self.goals.append(goal)
        return GoalResponse.REJECT if self._outcomes[0] == 'refuse' else GoalResponse.ACCEPT

    def _cancel(self, handle):
        self.cancelled.set_result(True)
        return CancelResponse.ACCEPT

    async def _execute(self, handle):
        outcome = self._outcomes.pop(0) if len(self._outcomes) > 1 else self._outcomes[0]
        if outcome == 'hang':
            await self.cancelled
            handle.canceled()
        elif outcome == 'collide':
            handle.abort()
            return self._spin.Result(error_code=self._spin.Result.COLLISION_AHEAD,
                                     error_msg='Collision Ahead')
        else:
            self.yaw += handle.request.target_yaw
            handle.succeed()
        return self._spin.Result()


@pytest.fixture
def serve_spin(tester):
    """Serve the action spin in the test's node, with outcomes."""
    started = []

    def run(*outcomes):
        started.append(Spinner(tester, *outcomes))
        return started[-1]
    yield run
    started[-1].server.destroy()


def test_refusals_end_when_time_is_up(relocalizer, start, end, tester):
    for timeout_s in (3, 12, 48):  # as long as a busy machine needs
        process = start('cli.wake_up', '--turn-deg', 0, '--timeout', timeout_s)
        code = end(process, poor_frame)
        if 'look 2 ' in process.output():
            break
    assert code == REFUSED
    answers = looks(process)
    assert [number for number, _, _ in answers] == [*range(1, len(answers) + 1)]
    assert len(answers) > 1
    assert all(answer.startswith('refused: 2 ') for _, _, answer in answers)
    assert process.output().count('not turning: ') == 1
    assert re.search(rf'refused: {len(answers)} looks in \d+ s: {len(answers)} too_few_objects$',
                     process.output(), re.MULTILINE)
    assert not tester.initial_poses


@pytest.mark.needs('nav2_msgs')
def test_the_robot_turns_until_it_sees_enough(relocalizer, start, end, serve_spin):
    spinner = serve_spin('turn', 'collide', 'turn')
    process = start('cli.wake_up', '--turn-deg', 30)
    # after a collision it turns the other way, past its start
    assert end(process, lambda: make_frame() if spinner.yaw < -0.4 else poor_frame()) == ACCEPTED
    steps = [math.degrees(goal.target_yaw) for goal in spinner.goals]
    # an image from before a turn may still be in transit, which causes another turn
    assert steps[:4] == pytest.approx([30.0, 30.0, -30.0, -30.0])
    turns = [turned for _, turned, _ in looks(process) if turned]
    assert len(turns) == len(steps)
    assert all(goal.time_allowance.sec == 10 for goal in spinner.goals)
    assert turns[:4] == [
        ', turned by 30 deg',
        ', not turned by 30 deg (aborted: collision ahead, Collision Ahead, code 703)',
        ', turned by -30 deg', ', turned by -30 deg']
    *others, last = [answer.split(':')[0] for _, _, answer in looks(process)]
    assert (set(others), last) == ({'refused'}, 'accepted')


@pytest.mark.full
@pytest.mark.needs('nav2_msgs')
def test_an_interrupt_stops_the_robot(relocalizer, start, end, tester, serve_spin):
    spinner = serve_spin('hang')
    process = start('cli.wake_up')

    def work():
        tester.publish(poor_frame())
        tester.spin()
    wait_for(lambda: spinner.goals, 'a turn', work=work)
    process.send(signal.SIGTERM)
    assert end(process) == INTERRUPTED
    assert spinner.cancelled.done()
    tester.wait(lambda: tester.listened_to() == 0, 'the end of the poor frames')
    assert tester.relocalize(make_frame()).success


def test_a_sure_pose_is_accepted_with_the_first_look(relocalizer, start, end):
    process = start('cli.wake_up')
    assert end(process, make_frame) == ACCEPTED
    ((number, turned, answer),) = looks(process)
    assert (number, turned) == (1, '')
    assert answer.startswith('accepted: x 0.3')
    process = start('cli.wake_up', '--watch')
    assert end(process, make_frame) == NOT_READY
    assert 'parameter watch' in process.output()


def test_without_a_relocalizer_it_is_not_ready(start, end):
    process = start('cli.wake_up', '--relocalizer', '/nowhere/relocalizer', '--timeout', 1)
    assert end(process) == NOT_READY
    assert 'not ready: nothing' in process.output()
