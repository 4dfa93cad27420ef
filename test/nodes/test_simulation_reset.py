# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulation that is reset while a robot moves: real /clock and odometry."""

from processes import wait_for
from rosgraph_msgs.msg import Clock
from tester import RELIABLE, transform_of
from watched import MOUNT, TICK_S, Robot, stamp

from cliploc_ros.core.geometry.transforms import pose_error


class World:
    """A simulation with a robot, whose odometry begins at a different place in each run."""

    def __init__(self, tester, now_s):
        self._tester, self.now_s = tester, now_s
        self._clock = tester.create_publisher(Clock, '/clock', RELIABLE)
        self.robot = Robot(tester)
        self.robot.clock, self.robot.on_tick = lambda: self.now_s, self.tick
        self.robot.has_localizer = False

    def close(self):
        self.robot.close()
        self._tester.destroy_publisher(self._clock)

    def tick(self, now_s, *_):
        self._clock.publish(Clock(clock=stamp(now_s)))
        self.now_s = round(now_s + TICK_S, 6)

    def reset(self, now_s):
        """Start another run at a time."""
        self.now_s = now_s
        self.robot.carry(0.4)
        self._clock.publish(Clock(clock=stamp(now_s)))

    def check(self):
        """Request a pose; check that it is the robot's pose in the current run."""
        future, self.robot.speed_m_s = self._tester.ask(), 0.0
        wait_for(future.done, 'an answer', work=self.robot.step)
        assert future.result().success, future.result().message
        self._tester.wait(lambda: self._tester.poses, 'the pose')
        error_m, error_deg = pose_error(transform_of(self._tester.poses[-1].pose.pose),
                                        self.robot.map_from_base)
        assert error_m < 0.05 and error_deg < 1.0, (error_m, error_deg)
        self._tester.forget()


def test_the_first_request_after_a_reset_is_right(own_relocalizer, tester):
    process = own_relocalizer(
        base_from_camera=MOUNT, base_frame='base_link', algorithm='auto', use_sim_time=True,
        timeout_s=20.0)
    world = World(tester, 100.0)
    for _ in range(20):
        world.robot.step()
    world.check()
    world.reset(world.now_s - 5.0)
    world.check()
    world.close()
    assert 'jumped back' in process.output()
    assert process.alive and 'Traceback' not in process.output()
