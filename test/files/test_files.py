# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The append-only log, and tasks on processes, some of which die."""

import os
import signal
import subprocess
import sys
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from disks import read_only_disk, small_disk

from cliploc_ros.errors import DatasetError, OptionsError
from cliploc_ros.files.log import Log
from cliploc_ros.files.parallel import WorkersError, map_tasks, run_tasks
from cliploc_ros.files.storage import is_foreign, read_file

PROJECT = Path(__file__).resolve().parents[2]


def test_a_stream_of_the_kernel_is_no_file():
    """Its size is 0, and reading it may give nothing, or not end."""
    with pytest.raises(OSError, match='not a regular file'):
        read_file('/proc/self/status')


def open_log(path):
    return closing(Log(path, DatasetError, 'make room'))


def read(path):
    with open_log(path) as log:
        return log.read()


def write(path, *entries):
    with open_log(path) as log:
        log.read()
        for entry in entries:
            log.append(entry)
    return read(path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'log'


def test_entries_survive(path):
    assert read(path) == ([], False)
    assert write(path, {'one': 1}, []) == ([{'one': 1}, []], False)
    assert write(path, 'three') == ([{'one': 1}, [], 'three'], False)


@pytest.mark.parametrize('lost', [1, 8])
def test_an_entry_that_was_cut_off_is_replaced(path, lost):
    write(path, 'one', 'second')
    path.write_bytes(path.read_bytes()[:-lost])
    assert read(path) == (['one'], False)
    assert write(path, 'three') == (['one', 'three'], False)


@pytest.mark.parametrize('line', [b'rubbish\n', b'\xff\xfe\n', b'[' * 100_000 + b'\n', b'\n'])
def test_a_damaged_line_ends_the_entries(path, line):
    write(path, 'one', 'second')
    path.write_bytes(path.read_bytes().replace(b'"second"\n', line + b'"third"\n'))
    assert read(path) == (['one'], True)
    with open_log(path) as log:
        aside = log.set_aside()
        assert log.set_aside() != aside
    assert aside.read_bytes().endswith(line + b'"third"\n')
    assert write(path, 'four') == (['one', 'four'], False)


def test_restart_and_remove(path):
    write(path, 'one', 'second')
    with open_log(path) as log:
        log.restart(['other'])
        assert log.read() == (['other'], False)
        log.remove()
    assert not path.exists()


def test_a_full_disk(path, tmp_path):
    code = ('import sys; from pathlib import Path; from cliploc_ros.files.log import Log\n'
            'from cliploc_ros.errors import DatasetError\n'
            f'log = Log(Path({str(path)!r}), DatasetError, "make room")\n'
            'for write in (lambda: [log.append("x" * 5000) for _ in range(100)],\n'
            '              lambda: log.restart(["y" * 5000] * 100), log.set_aside):\n'
            '    try:\n'
            '        write()\n'
            '    except DatasetError as error:\n'
            '        print(error)\n'
            '    entries, is_damaged = log.read()\n'
            '    print(len(entries), is_damaged)\n'
            'print([one.name for one in log.path.parent.iterdir()])\n')
    done = subprocess.run([*small_disk(tmp_path), sys.executable, '-c', code], cwd=PROJECT,
                          capture_output=True, text=True, timeout=60, check=True)
    *lines, there = done.stdout.splitlines()
    assert len(lines) == 6 and all('No space left' in line for line in lines[::2])
    assert len({*lines[1::2]}) == 1 and lines[1].endswith('False')
    assert 8 <= int(lines[1].split()[0]) <= 13 and there == "['log']"


FILES = """
import sys
from pathlib import Path
from matplotlib.figure import Figure
from cliploc_ros.command import check_output
from cliploc_ros.errors import CliplocError
from cliploc_ros.files.arrays import Field, Schema
from cliploc_ros.files.storage import make_folder, write_file
import numpy as np
disk = Path(sys.argv[1])
try:
    (disk / 'full').write_bytes(bytes(2**17))
except OSError:
    pass
for write in (lambda: make_folder(disk / 'out'), lambda: check_output(disk / 'map.yaml'),
              lambda: write_file(disk / 'a.png', Figure((20, 20)).savefig),
              lambda: Schema('file', {'a': Field('float64', ('N',))}, CliplocError).write(
                  disk / 'a.npz', {'a': np.zeros(2**14)})):
    try:
        write()
    except CliplocError as error:
        print(error)
print(sorted(one.name for one in disk.rglob('*')))
"""


@pytest.mark.parametrize(('kind', 'cause', 'left'), [
    (small_disk, 'No space left on device', ['full', 'out']),
    (read_only_disk, 'Read-only file system', [])])
def test_what_cannot_be_written_is_named_with_the_remedy(tmp_path, kind, cause, left):
    done = subprocess.run([*kind(tmp_path), sys.executable, '-c', FILES, str(tmp_path)],
                          cwd=PROJECT, capture_output=True, text=True, timeout=60, check=True)
    *messages, kept = done.stdout.splitlines()
    if kind is read_only_disk:
        assert 'map.yaml' in (refused := messages.pop(1)) and 'another folder' in refused
    for name, message in zip(('out', 'a.png', 'a.npz'), messages, strict=True):
        assert message.startswith(str(tmp_path / name)) and cause in message
        assert 'make room, or choose another folder' in message
    assert kept == str(left)


@dataclass(frozen=True, eq=False)
class Square:
    """Squares numbers, and dies at one of them."""

    deadly: int = -1

    def __call__(self):
        return self.square

    def square(self, number):
        if number == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number, os.getpid()


def results(make_work, **options):
    return {task: result[0] for task, result in run_tasks(make_work, range(12), **options)}


SQUARES = {number: number * number for number in range(12)}


@pytest.mark.parametrize('workers', [1, 2])
def test_in_this_process_or_in_two_others(workers):
    finished = dict(run_tasks(Square(), range(12), workers=workers))
    assert {task: result[0] for task, result in finished.items()} == SQUARES
    assert (os.getpid() in {result[1] for result in finished.values()}) == (workers == 1)


@pytest.mark.parametrize('workers', [1, 2])
def test_results_in_the_order_of_the_tasks(workers):
    tasks = ((number, 2) for number in range(12))
    assert map_tasks(pow, tasks, workers=workers) == [*SQUARES.values()]


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


def test_the_death_of_a_worker_is_an_error_that_names_the_remedy():
    with pytest.raises(WorkersError, match=r'out of memory; .* fewer workers'):
        results(Square(5), workers=2)


def test_an_error_of_a_task_is_not_that_of_a_worker():
    with pytest.raises(TypeError):
        dict(run_tasks(Square(), ['text'], workers=2))


def test_without_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)  # as if it were not installed
    with pytest.raises(OptionsError, match='pip install'):
        results(Square(), scheduler='tcp://127.0.0.1:9')


@contextmanager
def local_cluster(workers):
    """Start a scheduler and workers, which restart when they die."""
    import dask
    from distributed import LocalCluster

    with (dask.config.set({'distributed.scheduler.allowed-failures': 1}),
          LocalCluster(n_workers=workers, threads_per_worker=1, processes=True,
                       dashboard_address='127.0.0.1:0') as cluster):
        yield cluster


@pytest.mark.full
def test_a_dead_worker_of_a_cluster_costs_time_only_and_a_deadly_task_is_an_error():
    found = {}
    with local_cluster(2) as cluster:
        address = cluster.scheduler_address
        for task, result in run_tasks(Square(), range(12), scheduler=address):
            if len(found) == 5:
                os.kill(min(one.pid for one in cluster.workers.values()), signal.SIGKILL)
            found[task] = result[0]
        assert found == SQUARES
        with pytest.raises(WorkersError, match='its workers died'):
            results(Square(7), scheduler=address)
    with (local_cluster(0) as empty, pytest.raises(WorkersError, match='has no workers')):
        results(Square(), scheduler=empty.scheduler_address)
    with pytest.raises(WorkersError, match='at nonsense'):
        results(Square(), scheduler='nonsense')


@pytest.mark.parametrize(('mode', 'is_own_group', 'foreign'), [
    (0o755, False, False), (0o775, True, False), (0o775, False, True), (0o777, True, True)])
def test_what_a_group_of_others_can_write_to_is_foreign(tmp_path, mode, is_own_group, foreign):
    others = [group for group in os.getgroups() if group not in (0, os.getgid())] or [12345]
    os.chown(tmp_path, -1, os.getgid() if is_own_group else others[0])
    tmp_path.chmod(mode)
    assert is_foreign(tmp_path.stat(), {os.getuid()}) is foreign
    assert is_foreign(tmp_path.stat(), {os.getuid() + 1})
