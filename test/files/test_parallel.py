# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent tasks on processes, some of which die."""

import logging
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from cliploc_ros.errors import OptionsError
from cliploc_ros.files.parallel import WorkersError, run_tasks


@dataclass(frozen=True)
class Square:
    """Squares numbers; dies at one of them."""

    deadly: int = -1

    def __call__(self):
        return self.square

    def square(self, number):
        if number == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number, os.getpid()


def results(make_work, count=12, **options):
    return {task: None if result is None else result[0]
            for task, result in run_tasks(make_work, range(count), **options)}


SQUARES = {number: number * number for number in range(12)}


@pytest.mark.parametrize('workers', [1, 2])
def test_in_this_process_or_in_two_others(workers):
    finished = dict(run_tasks(Square(), range(12), workers=workers))
    assert {task: result[0] for task, result in finished.items()} == SQUARES
    assert (os.getpid() in {result[1] for result in finished.values()}) == (workers == 1)


def test_tasks_are_taken_as_workers_become_free():
    taken = []

    def tasks():
        for number in range(100):
            taken.append(number)
            yield number
    stream = run_tasks(Square(), tasks(), workers=2)
    next(stream)
    assert len(taken) < 10
    stream.close()


@dataclass(frozen=True)
class OneDies:
    """Task 0 kills its worker once, while task 1 runs; task 1 ends after that."""

    folder: Path

    def __call__(self):
        return self.do

    def do(self, number):
        begun, other = self.folder / f'{number}', self.folder / f'{1 - number}'
        is_first = not begun.exists()
        with begun.open('a') as file:
            file.write(f'{os.getpid()}\n')
        self.wait(other.exists)
        if number == 0 and is_first:
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 1:
            self.wait(lambda: not Path(f'/proc/{other.read_text().split()[0]}').exists())
        return number

    @staticmethod
    def wait(condition):
        deadline = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_the_death_of_a_worker_costs_its_own_tasks_only(tmp_path):
    assert dict(run_tasks(OneDies(tmp_path), range(2), workers=2)) == {0: 0, 1: 1}
    assert [len((tmp_path / name).read_text().split()) for name in '01'] == [2, 1]


def test_workers_that_all_die_end_the_run():
    with pytest.raises(WorkersError):
        list(run_tasks(Square(7), [7] * 20, workers=2))


def test_a_deadly_task_is_given_up_alone(caplog):
    with caplog.at_level(logging.WARNING):
        assert results(Square(5), workers=2) == SQUARES | {5: None}
    assert 'left out' in caplog.text


def test_without_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)  # as where it is not installed
    with pytest.raises(OptionsError, match='pip install'):
        results(Square(), scheduler='tcp://127.0.0.1:9')
