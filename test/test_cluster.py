# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tasks on a real Dask cluster with workers that die or are missing."""

import os
import signal
from contextlib import contextmanager
from dataclasses import dataclass

import dask
import pytest
from distributed import LocalCluster

from cliploc_ros.files.parallel import WorkersError, run_tasks

pytestmark = pytest.mark.full


@contextmanager
def local_cluster(workers=2, allowed_failures=3):
    """Start a scheduler with single-threaded worker processes, which restart when they die."""
    with (dask.config.set({'distributed.scheduler.allowed-failures': allowed_failures}),
          LocalCluster(n_workers=workers, threads_per_worker=1, processes=True,
                       dashboard_address='127.0.0.1:0') as cluster):
        yield cluster


@dataclass(frozen=True, eq=False)
class Cube:
    """Cubes numbers; kills its worker at one of them."""

    deadly: int = -1

    def __call__(self):
        return self.cube

    def cube(self, number):
        if number == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return number ** 3


def test_a_dead_worker_costs_time_only_and_a_deadly_task_is_an_error():
    found = {}
    with local_cluster(allowed_failures=1) as cluster:
        address = cluster.scheduler_address
        for task, result in run_tasks(Cube(), range(40), scheduler=address):
            if len(found) == 5:
                os.kill(min(one.pid for one in cluster.workers.values()), signal.SIGKILL)
            found[task] = result
        assert found == {number: number ** 3 for number in range(40)}
        with pytest.raises(WorkersError, match='its workers died'):
            dict(run_tasks(Cube(7), range(20), scheduler=address))


def test_no_scheduler_and_no_workers():
    with pytest.raises(WorkersError, match='at nonsense'):
        dict(run_tasks(Cube(), range(3), scheduler='nonsense'))
    with (local_cluster(workers=0) as empty,
          pytest.raises(WorkersError, match='has no workers')):
        dict(run_tasks(Cube(), range(3), scheduler=empty.scheduler_address))
