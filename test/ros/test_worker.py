# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import threading
import time
from concurrent.futures import CancelledError

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.errors import CliplocError, InternalError, StoppedError, TimeUpError
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

    def __call__(self, result=None):
        self.entered.set()
        assert self._open.wait(PATIENCE_S)
        return result

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


def fail_with(error):
    def task():
        raise error
    return task


@pytest.mark.parametrize('error', [
    ValueError('shapes differ'), KeyError('boxes'), MemoryError('2 GiB'), RuntimeError('CUDA'),
    AssertionError('')], ids=repr)
def test_a_defect_is_reported_with_its_traceback_and_survived(worker, reports, error):
    with pytest.raises(InternalError, match='in the log') as raised:
        worker.run(fail_with(error))
    assert type(error).__name__ in str(raised.value) and str(error) in str(raised.value)
    assert raised.value.__cause__ is error
    assert len(reports) == 1
    assert 'Traceback' in reports[0] and 'raise error' in reports[0]
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


@pytest.mark.clock
def test_stop_does_not_wait_for_a_long_task_but_drops_what_waits(worker, gate):
    running = gate.hold(worker)
    ran = []
    waiting = [worker.submit(lambda: ran.append('never')) for _ in range(3)]
    start = time.monotonic()
    worker.stop()
    assert time.monotonic() - start < 2.0
    assert all(future.cancelled() for future in waiting)
    with pytest.raises(CancelledError):
        waiting[0].result(0)
    gate.open()
    assert running.result(PATIENCE_S) is None
    worker.stop()
    assert ran == []


def test_whoever_waits_in_run_learns_that_the_node_stops(worker, gate):
    learned = []

    def ask():
        with pytest.raises(CliplocError) as raised:
            worker.run(gate)
        learned.append(raised.type)
    asker = threading.Thread(target=ask)
    asker.start()
    assert gate.entered.wait(PATIENCE_S)
    worker.stop()
    asker.join(PATIENCE_S / 2)  # before the gate times out
    assert learned == [StoppedError]


def test_only_the_newest_waits_while_the_worker_is_busy(worker, gate):
    done = []
    latest = LatestOnly(worker, done.append)
    gate.hold(worker)
    for item in range(100):
        latest.offer(item)
    assert latest.dropped == 99
    gate.open()
    worker.run(lambda: None)
    assert done == [99]


@given(st.lists(st.booleans(), max_size=40))
def test_the_last_item_is_never_lost(pauses):
    worker, done = Worker(print), []
    latest = LatestOnly(worker, done.append)
    for item, pause in enumerate(pauses):
        latest.offer(item)
        if pause:
            worker.run(lambda: None)
            assert done[-1] == item
    worker.run(lambda: None)
    worker.stop()
    assert done == sorted(set(done))
    assert done[-1:] == list(range(len(pauses)))[-1:]
    assert len(done) + latest.dropped == len(pauses)
