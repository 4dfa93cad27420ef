# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels' cache on disk may be damaged; the search still works."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PROJECT = Path(__file__).resolve().parents[2]
# A few kernels of one module, which are compiled within a second; then one that calls them.
FEW = """
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.geometry.ellipse import unit_circle_overlap
warm_up(lambda: unit_circle_overlap(0.1, 0.2, 1.0, 2.0))
print('warm')
"""
CALLER = """
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.geometry.ellipse import ellipse_iou
warm_up(lambda: ellipse_iou(0.0, 0.0, 1.0, 2.0, 0.1, 0.2, 1.0, 0.0, 1.0))
print('warm')
"""


def run(code, folder):
    """Run a program whose compiled kernels are kept in a folder."""
    return subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          cwd=PROJECT, check=False,
                          env=os.environ | {'NUMBA_CACHE_DIR': str(folder)})


@pytest.mark.parametrize(('ending', 'size', 'code'), [('nbi', 0, FEW), ('nbc', 100, CALLER)])
def test_a_damaged_cache_is_mended(tmp_path, ending, size, code):
    assert run(FEW, tmp_path).stdout == 'warm\n'
    files = list(tmp_path.rglob(f'*.{ending}'))
    assert len(files) > 3
    for file in files:
        os.truncate(file, size)
    done = run(code, tmp_path)
    assert done.stdout == 'warm\n', done.stderr
    assert 'compiling them again' in done.stderr
    # and is whole again
    assert 'compiling them again' not in run(code, tmp_path).stderr


def test_a_cache_of_another_version_is_replaced(tmp_path):
    """After an upgrade, the index of a kernel may name a module that is gone."""
    assert run(FEW, tmp_path).stdout == 'warm\n'
    for file in tmp_path.rglob('*.nbi'):
        with file.open('rb') as index:
            pickle.load(index)  # numba's version
            end = index.tell()
        file.write_bytes(file.read_bytes()[:end] + b'ccliploc_ros.core.gone\nThing\n.')
    done = run(FEW, tmp_path)
    assert done.stdout == 'warm\n', done.stderr
    assert 'compiling them again' in done.stderr
    assert 'compiling them again' not in run(FEW, tmp_path).stderr


FULL_DISK = """
import logging, resource
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.geometry.cubic import largest_cubic_root
from cliploc_ros.core.geometry.ellipse import unit_circle_overlap
logging.basicConfig()
def run():
    return largest_cubic_root(0.0, 0.0, -8.0), unit_circle_overlap(0.0, 0.0, 1.0, 1.0)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))  # writing fails as on a full disk
warm_up(run)
print(*run())
"""


def test_a_full_disk_costs_only_the_cache(tmp_path):
    done = run(FULL_DISK, tmp_path)
    assert np.array(done.stdout.split(), float) == pytest.approx([2.0, np.pi]), done.stderr
    assert done.stderr.count('WARNING') == 1, 'not one for each kernel'
    assert 'NUMBA_CACHE_DIR' in done.stderr
    assert run(FULL_DISK.replace('(100, 100)', '(-1, -1)'), tmp_path).stderr == ''
    assert list(tmp_path.rglob('*.nbc'))
