# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node subscribes to a running camera, as the relocalizer does for each request."""

import os
import subprocess
import sys

import pytest
from processes import PATIENCE_S, PROJECT

pytestmark = pytest.mark.full

JOINERS, JOINS = 3, 40


@pytest.fixture
def run():
    """Start Python processes; kill them at the end of the test."""
    processes = []
    environment = os.environ | {'PYTHONPATH': f'{PROJECT}:{os.environ.get("PYTHONPATH", "")}'}

    def start(*arguments):
        processes.append(subprocess.Popen(
            [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, text=True,
            cwd=PROJECT, env=environment))
        return processes[-1]
    yield start
    for process in processes:
        process.kill()
        process.communicate()


def test_every_join_receives_images(run):
    """Fast DDS soon blocked each of these processes if it deserialized the images itself."""
    for _ in range(os.cpu_count()):
        run('-c', 'while True: pass')  # on busy cores, a new subscription meets images in transit
    run('test/nodes/joiner.py', 'publish')
    joiners = [run('test/nodes/joiner.py', 'join', JOINS) for _ in range(JOINERS)]
    joined = [joiner.communicate(timeout=2 * PATIENCE_S)[0].count(' s\n') for joiner in joiners]
    assert joined == [JOINS] * JOINERS
