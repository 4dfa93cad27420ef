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


def test_every_join_receives_images():
    """Fast DDS soon blocked each of these processes if it deserialized the images itself."""
    processes = []

    def run(*arguments):
        processes.append(subprocess.Popen(
            [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, text=True,
            cwd=PROJECT, env=os.environ | {
                'PYTHONPATH': f'{PROJECT}:{os.environ.get("PYTHONPATH", "")}'}))
        return processes[-1]
    try:
        for _ in range(os.cpu_count()):
            run('-c', 'while True: pass')  # busy cores: new subscriptions meet images in transit
        run('test/nodes/joiner.py', 'publish')
        joiners = [run('test/nodes/joiner.py', 'join', JOINS) for _ in range(JOINERS)]
        joined = [joiner.communicate(timeout=2 * PATIENCE_S)[0].count(' s\n')
                  for joiner in joiners]
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert joined == [JOINS] * JOINERS
