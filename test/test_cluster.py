# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tasks on a real Dask cluster with workers that die, are missing, or have another version."""

from dataclasses import dataclass

import pytest
from clusters import kill_a_worker, local_cluster

from cliploc_ros.files.parallel import WorkersError, run_tasks

pytestmark = pytest.mark.full


@dataclass(frozen=True, eq=False)
class Cube:
    """Cubes numbers."""

    def __call__(self):
        return lambda number: number ** 3


@pytest.fixture(scope='module')
def cluster():
    with local_cluster(allowed_failures=0) as running:
        yield running


def test_a_dead_worker_costs_time_only(cluster):
    found = {}
    for task, result in run_tasks(Cube(), range(40), scheduler=cluster.scheduler_address):
        if len(found) == 5:
            kill_a_worker(cluster)
        found[task] = result
    assert found == {number: number ** 3 for number in range(40)}


def test_no_scheduler_and_no_workers():
    with pytest.raises(WorkersError, match='at nonsense'):
        dict(run_tasks(Cube(), range(3), scheduler='nonsense'))
    with (local_cluster(workers=0) as empty,
          pytest.raises(WorkersError, match='has no workers')):
        dict(run_tasks(Cube(), range(3), scheduler=empty.scheduler_address))
