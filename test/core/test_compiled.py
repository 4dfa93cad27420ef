# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels' cache on disk may be damaged; the search still works."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
WARM_UP = """
import numpy as np
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
room = LandmarkMap('map', ('a',) * 3, ('a',) * 3, ('a',) * 3, np.zeros((3, 3)), np.ones((3, 3)),
                   np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
Relocalizer(room, RelocalizerOptions(k=1)).warm_up()
print('warm')
"""


@pytest.fixture(scope='module')
def warm_cache(tmp_path_factory):
    """A cache of compiled kernels of its own."""
    folder = tmp_path_factory.mktemp('numba')
    assert run(folder).stdout == 'warm\n'
    return folder


def run(folder):
    return subprocess.run([sys.executable, '-c', WARM_UP], capture_output=True, text=True,
                          cwd=PROJECT, check=False,
                          env=os.environ | {'NUMBA_CACHE_DIR': str(folder)})


@pytest.mark.parametrize(('ending', 'size'), [('nbi', 0), ('nbc', 100)])
def test_a_damaged_cache_is_mended(warm_cache, ending, size):
    files = list(warm_cache.rglob(f'*.{ending}'))
    assert files
    for file in files:
        os.truncate(file, size)
    done = run(warm_cache)
    assert done.stdout == 'warm\n', done.stderr
    # and is whole again
    assert 'compiling anew' not in run(warm_cache).stderr
