# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cliploc_ros.errors import InternalError, StoppedError, TimeUpError
from cliploc_ros.nodes.detector import NewestInstant, TimedImage
from cliploc_ros.ros.node.threads import LatestOnly, Worker

PATIENCE_S = 60.0


@pytest.fixture
def reports():
    return []


@pytest.fixture
def worker(reports):
    worker = Worker(reports.append)
    yield worker
    worker.stop()


class Gate:
    """A task that runs until it is released."""

    def __init__(self):
        self.entered, self._open = threading.Event(), threading.Event()

    def __call__(self):
        self.entered.set()
        assert self._open.wait(PATIENCE_S)

    def open(self):
        self._open.set()

    def hold(self, worker):
        """Keep a worker busy; return the future."""
        future = worker.submit(self)
        assert self.entered.wait(PATIENCE_S)
        return future


@pytest.fixture
def gate(worker):
    gate = Gate()
    yield gate
    gate.open()


def test_a_defect_is_reported_with_its_traceback_and_survived(worker, reports):
    def task():
        raise KeyError('boxes')
    with pytest.raises(InternalError, match=r"KeyError: 'boxes' .*in the log") as raised:
        worker.run(task)
    assert isinstance(raised.value.__cause__, KeyError)
    assert len(reports) == 1
    assert 'Traceback' in reports[0] and 'raise KeyError' in reports[0]
    assert worker.run(lambda: 'alive') == 'alive'


def test_a_task_whose_time_is_up_before_its_turn_never_runs(worker, gate):
    """Otherwise requests that time out would accumulate behind a slow task."""
    running, ran = gate.hold(worker), []
    for number in range(3):
        with pytest.raises(TimeUpError):
            worker.run(lambda number=number: ran.append(number), time.monotonic() + 0.01)
    gate.open()
    running.result(PATIENCE_S)
    assert worker.run(lambda: 'next') == 'next'
    assert ran == []


def test_stop_drops_what_waits_and_ends_each_wait(worker, gate):
    """A long task cannot be ended: nobody waits for it."""
    ran = []
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(worker.run, gate)
        assert gate.entered.wait(PATIENCE_S)
        waiting = [worker.submit(lambda: ran.append('never')) for _ in range(3)]
        worker.stop()
        try:
            with pytest.raises(StoppedError):
                asking.result(PATIENCE_S / 2)  # before the gate times out
        finally:
            gate.open()
    assert all(future.cancelled() for future in waiting) and ran == []


@given(st.lists(st.booleans(), max_size=40))
def test_the_last_item_is_never_lost_and_only_the_newest_waits(pauses):
    worker, done, gate = Worker(print), [], Gate()
    latest = LatestOnly(worker, done.append)
    for item, pause in enumerate(pauses):
        latest.offer(item)
        if pause:
            worker.run(lambda: None)
            assert done[-1] == item
    gate.hold(worker)
    for item in range(len(pauses), len(pauses) + 3):
        latest.offer(item)
    gate.open()
    worker.run(lambda: None)
    worker.stop()
    assert done == sorted(set(done)) and done[-1] == len(pauses) + 2
    assert len(done) + latest.dropped == len(pauses) + 3 and latest.dropped >= 2


@pytest.mark.parametrize(('offers', 'expected', 'dropped'), [
    # the newest instant that both have, then the remaining images
    ([('a', 1), ('b', 1), ('a', 2)], [('a', 1), ('b', 1), ('a', 2)], 0),
    ([('a', 1), ('b', 1), ('a', 2), ('b', 2)], [('a', 2), ('b', 2)], 2),
    ([('a', 1), ('a', 2), ('a', 3), ('b', 1)], [('a', 2), ('b', 1), ('a', 3)], 1),
    # a late camera does not delay the others
    ([('a', 8), ('a', 9), ('b', 3)], [('a', 8), ('b', 3), ('a', 9)], 0)])
def test_images_of_one_instant_come_together(worker, gate, offers, expected, dropped):
    """The worker is busy while the images arrive."""
    seen = []
    newest = NewestInstant(worker, lambda camera, one: seen.append(
        (camera, one.msg.header.stamp.sec)))
    gate.hold(worker)
    for camera, stamp in offers:
        newest.offer(camera, TimedImage(Image(header=Header(stamp=Time(sec=stamp))), float(stamp)))
    assert newest.waiting_since is not None
    gate.open()
    for _ in range(3):
        worker.run(lambda: None)
    assert newest.waiting_since is None
    assert (seen, newest.dropped) == (expected, dropped)
