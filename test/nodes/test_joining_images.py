# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node subscribes to a camera that is already running; the relocalizer does for each request."""

import subprocess
import sys
from contextlib import contextmanager

from processes import PATIENCE_S, PROJECT

JOINS = 100


@contextmanager
def joiner(*arguments):
    process = subprocess.Popen([sys.executable, PROJECT / 'test/nodes/joiner.py', *arguments],
                               stdout=subprocess.PIPE, text=True, cwd=PROJECT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_every_join_receives_images():
    """Fast DDS blocked about one of fifty where it deserialized the images itself."""
    with joiner('publish'), joiner('join', str(JOINS)) as process:
        output, _ = process.communicate(timeout=2 * PATIENCE_S)
    assert output.count(' s\n') == JOINS
