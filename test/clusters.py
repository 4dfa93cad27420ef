# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dask clusters on this machine."""

import os
import signal
from contextlib import contextmanager

import dask
from distributed import LocalCluster

TIMEOUT_S = 300.0


@contextmanager
def local_cluster(workers=2, allowed_failures=3):
    """Start a scheduler with single-threaded worker processes, which restart when they die."""
    with (dask.config.set({'distributed.scheduler.allowed-failures': allowed_failures}),
          LocalCluster(n_workers=workers, threads_per_worker=1, processes=True,
                       dashboard_address='127.0.0.1:0') as cluster):
        yield cluster


def kill_a_worker(cluster):
    """Kill the process of the first worker; return its id."""
    pid = min(nanny.pid for nanny in cluster.workers.values())
    os.kill(pid, signal.SIGKILL)
    return pid
