# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tasks on a real Dask cluster, whose workers die, are missing, or are of another version."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import pytest
from clusters import TIMEOUT_S, kill_a_worker, local_cluster
from distributed import Client

from cliploc_ros.errors import DatasetError
from cliploc_ros.files.parallel import WorkersError, digest_of_sources, run_tasks

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, eq=False)
class Cube:
    """Cubes numbers; fails or kills its process at one of them."""

    failing: int = -1
    deadly: int = -1

    def __call__(self):
        return self.cube

    def cube(self, number):
        if number == self.failing:
            raise DatasetError(f'{number} cannot be read; take another one')
        if number == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return number ** 3, os.getpid()


@pytest.fixture(scope='module')
def cluster():
    with local_cluster(allowed_failures=0) as running:
        yield running


def test_a_dead_worker_costs_time_only(cluster):
    found = {}
    for task, result in run_tasks(Cube(), range(40), scheduler=cluster.scheduler_address):
        if len(found) == 5:
            kill_a_worker(cluster)
        found[task] = result[0]
    assert found == {number: number ** 3 for number in range(40)}


def test_a_deadly_task_is_given_up(cluster, caplog):
    found = dict(run_tasks(Cube(deadly=3), range(6), scheduler=cluster.scheduler_address))
    assert found.pop(3) is None
    assert {task: result[0] for task, result in found.items()} == {
        number: number ** 3 for number in range(6) if number != 3}
    assert 'left out: workers died again and again at 3' in caplog.text


def test_an_error_of_a_task_arrives_as_it_is(cluster):
    with pytest.raises(DatasetError, match='3 cannot be read; take another one'):
        dict(run_tasks(Cube(failing=3), range(9), scheduler=cluster.scheduler_address))


def test_no_scheduler_and_no_workers():
    with pytest.raises(WorkersError, match='no Dask scheduler answers at nonsense'):
        dict(run_tasks(Cube(), range(3), scheduler='nonsense'))
    with (local_cluster(workers=0) as empty,
          pytest.raises(WorkersError, match='has no workers; start some with "dask worker tcp')):
        dict(run_tasks(Cube(), range(3), scheduler=empty.scheduler_address))


def test_a_scheduler_that_goes_away():
    with local_cluster(workers=1) as short_lived:
        stream = run_tasks(Cube(), range(1000), scheduler=short_lived.scheduler_address)
        next(stream)
        closing = threading.Thread(target=short_lived.close)
        closing.start()
        with pytest.raises(WorkersError, match='is gone; start it and run again'):
            list(stream)
        closing.join()


def test_a_worker_of_another_version(tmp_path):
    shutil.copytree(PROJECT / 'cliploc_ros', tmp_path / 'cliploc_ros', ignore=lambda folder, names:
                    [name for name in names if not (Path(folder) / name).is_dir()
                     and not name.endswith('.py')])
    with (tmp_path / 'cliploc_ros/units.py').open('a') as source:
        source.write('# of another day\n')
    with local_cluster(workers=0) as empty:
        address = empty.scheduler_address
        worker = subprocess.Popen(
            [sys.executable, '-m', 'distributed.cli.dask_worker', address, '--no-nanny',
             '--no-dashboard'], cwd=tmp_path, env=os.environ | {
                 'PYTHONPATH': f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}'},
            stderr=subprocess.DEVNULL)
        try:
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=TIMEOUT_S)
            with pytest.raises(WorkersError, match=r'has sources \w{8} of cliploc_ros, here are '
                               + digest_of_sources()):
                dict(run_tasks(Cube(), range(3), scheduler=address))
        finally:
            worker.terminate()
            worker.wait(TIMEOUT_S)
