# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A flag that signals can set at any time."""

import os
import resource
import signal
import time
from pathlib import Path

import pytest

from cliploc_ros.command import Interruption

ALARMS = 300
OPEN = Path('/proc/self/fd')


@pytest.fixture
def alarm():
    """Restore the process's timer and its signal handler."""
    handler = signal.getsignal(signal.SIGALRM)
    yield lambda after_s: signal.setitimer(signal.ITIMER_REAL, after_s)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, handler)


def test_a_signal_may_come_at_any_moment_of_a_wait(alarm):
    """With threading.Event, one of these signals arrives while the event's lock is held."""
    for number in range(ALARMS):
        interruption = Interruption()
        interruption.catch(signal.SIGALRM)
        alarm(1e-4 + 1e-6 * number)
        while not interruption.wait(0.0):
            pass
        assert interruption.is_set()


def test_a_wait_ends_with_the_signal_or_with_its_time(alarm):
    interruption = Interruption()
    interruption.catch(signal.SIGALRM)
    start = time.monotonic()
    assert not interruption.wait(0.05)
    assert time.monotonic() - start >= 0.05
    alarm(0.02)
    assert interruption.wait(60.0)
    assert interruption.wait(60.0)
    assert time.monotonic() - start < 30.0


def test_a_process_with_many_files_waits_and_drops_its_own():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2048), hard))
    many = [os.dup(0) for _ in range(1100)]
    try:
        interruption = Interruption()
        assert not interruption.wait(0.01)
        interruption.set()
        assert interruption.wait(1e12)
        count = len([*OPEN.iterdir()])
        del interruption
        assert len([*OPEN.iterdir()]) == count - 1
    finally:
        for descriptor in many:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
