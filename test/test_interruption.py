# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A flag that signals can set at any time."""

import os
import resource
import subprocess
import sys
from pathlib import Path

from cliploc_ros.command import Interruption

OPEN = Path('/proc/self/fd')
# In a process of its own: the timer and its handler are those of the time limit of a test, and
# other tests leave threads behind.
WAITS = """
import signal, time
from cliploc_ros.command import Interruption

for number in range(300):  # with threading.Event, one signal arrives while its lock is held
    interruption = Interruption()
    interruption.catch(signal.SIGALRM)
    signal.setitimer(signal.ITIMER_REAL, 1e-4 + 1e-6 * number)
    while not interruption.wait(0.0):
        pass
    assert interruption.is_set()

interruption = Interruption()
interruption.catch(signal.SIGALRM)
start = time.monotonic()
assert not interruption.wait(0.05)
assert time.monotonic() - start >= 0.05
signal.setitimer(signal.ITIMER_REAL, 0.02)
assert interruption.wait(60.0) and interruption.wait(60.0)
assert time.monotonic() - start < 30.0
"""


def test_a_signal_ends_a_wait_at_any_moment_and_time_ends_it_too():
    subprocess.run([sys.executable, '-X', 'faulthandler', '-c', WAITS], check=True, timeout=100)


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
