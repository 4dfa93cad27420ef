# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A request succeeds where the localizer shows the pose: localizers that take it, or do not."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest
from processes import PROJECT
from tester import make_frame

# Of requests that no localizer takes. On a busy machine processes may meet after 3 s.
TIMEOUT_S = 6.0


@pytest.fixture
def amcl(tester):
    """Start a localizer like AMCL in a process; the test's own is off."""
    started = []

    def start(**arguments):
        started.append(subprocess.Popen(
            [sys.executable, 'test/nodes/amcl.py', *(f'{k}={v}' for k, v in arguments.items())],
            stdout=subprocess.PIPE, text=True, cwd=PROJECT, env=dict(os.environ)))
        tester.wait(lambda: tester.count_publishers('/amcl_pose') == 2, 'amcl_pose')
        assert started[-1].stdout.readline() == 'subscribed\n'
        return started[-1]
    tester.localizer.is_on = False
    yield start
    for process in started:
        process.terminate()  # a killed one would be taken for alive for 20 s
        process.send_signal(signal.SIGCONT)
        process.wait()
        process.stdout.close()
    tester.wait(lambda: tester.count_publishers('/amcl_pose') == 1, 'it to be gone')
    tester.localizer.is_on, tester.localizer.frame = True, None


@pytest.fixture
def node(own_relocalizer):
    return own_relocalizer(timeout_s=30.0, nomotion_updates=2)


def ends_of(process):
    """Return what became of each initial pose that a localizer was sent."""
    process.terminate()
    return process.stdout.read().split()


def test_a_localizer_that_shows_the_pose_got_it_once(amcl, node, tester):
    localizer = amcl()
    answer = tester.relocalize(make_frame())
    assert answer.success, answer.message
    assert ends_of(localizer) == ['took']


def why_not_taken(tester, stamp_s=100.0):
    """Request the pose; return why the localizer has not taken it."""
    tester.set_parameter('timeout_s', TIMEOUT_S)
    begin = time.monotonic()
    answer = tester.relocalize(make_frame(stamp_s=stamp_s))
    assert time.monotonic() - begin < TIMEOUT_S + 4.0
    assert not answer.success, answer.message
    found = re.match(r'withheld: the localizer did not take the pose: (.*) \(accepted: x 0\.3',
                     answer.message)
    assert found, answer.message
    return found[1]


@pytest.mark.parametrize(('arguments', 'named'), [
    ({'shows_x': 5.0}, r'.* 4\.70 m '),
    ({'deaf': 99, 'at_x': 0.3}, '.* shows nothing ')])
def test_a_localizer_that_shows_another_pose_or_none_has_not_taken_it(amcl, node, tester,
                                                                      arguments, named):
    """What it showed before does not count, though late subscribers get it."""
    amcl(**arguments)
    assert re.match(named, why_not_taken(tester))


def test_a_robot_whose_localizer_shows_no_pose_needs_a_subscriber(own_relocalizer, tester):
    """Whoever that is: no more is known with an empty localizer_pose."""
    tester.localizer.is_on = False
    try:
        own_relocalizer(localizer_pose="''")
        answer = tester.relocalize(make_frame())
        assert answer.success, answer.message
        tester.wait(lambda: tester.initial_poses, 'the pose')
    finally:
        tester.localizer.is_on = True
