# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels on disk: found by their source, written completely, and optional."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.core.options import ALGORITHMS, MATCHINGS

PROJECT = Path(__file__).resolve().parents[2]
# A few kernels, which are compiled within seconds. The last one calls the others.
PROGRAM = """
import logging
logging.basicConfig(format='%(levelname)s %(message)s', level=logging.INFO)
from cliploc_ros.core.kernels.compiled import COUNTS, warm_up
from cliploc_ros.core.geometry.ellipse import unit_circle_overlap
warm_up(lambda: unit_circle_overlap(0.0, 0.0, 1.0, 1.0))
print(COUNTS['missing'], unit_circle_overlap(0.0, 0.0, 1.0, 1.0))
"""
KERNELS = 4


def run(*within, package=PROJECT, program=PROGRAM, **environment):
    """Run the program; return the number of missing kernels, the result, and the log."""
    variables = {name: value for name, value in os.environ.items()
                 if name not in ('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME')}
    done = subprocess.run([*within, sys.executable, '-c', program], text=True, check=False,
                          capture_output=True, cwd='/', timeout=300,
                          env=variables | {'PYTHONPATH': str(package)} | environment)
    assert done.returncode == 0, done.stderr
    missing, result = done.stdout.split()
    return int(missing), float(result), done.stderr


def run_in(folder, **environment):
    return run(NUMBA_CACHE_DIR=str(folder), **environment)


@pytest.fixture(scope='module')
def compiled_kernels(tmp_path_factory):
    """Compile the kernels into a folder."""
    folder = tmp_path_factory.mktemp('kernels')
    missing, result, log = run_in(folder)
    assert missing == KERNELS and result == pytest.approx(np.pi)
    assert 'INFO compiling' in log
    assert f'INFO compiled {KERNELS} kernels in' in log and f'kept in {folder}' in log
    return folder


@pytest.fixture
def kernels(compiled_kernels, tmp_path):
    return Path(shutil.copytree(compiled_kernels, tmp_path / 'kernels'))


@pytest.fixture
def package(tmp_path):
    """Copy the package to another place, with new modification times."""
    copy = tmp_path / 'elsewhere'
    shutil.copytree(PROJECT / 'cliploc_ros', copy / 'cliploc_ros', copy_function=shutil.copy,
                    ignore=shutil.ignore_patterns('__pycache__'))
    return copy


def replace_in(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


@pytest.mark.once
def test_a_change_of_a_module_compiles_its_kernels_and_their_callers(kernels, package):
    count = len(list(kernels.iterdir()))
    replace_in(package / 'cliploc_ros/core/geometry/minimal_solvers.py', '_ROUNDING = 4e-16',
               '_ROUNDING = 5e-16')
    assert run_in(kernels, package=package)[0] == KERNELS
    assert len(list(kernels.iterdir())) == count, 'outdated kernels remain'


def test_damaged_kernels_are_compiled_again(kernels):
    """Index and code of two kernels each, cut or with a flipped bit."""
    damaged = [*sorted(kernels.glob('*.nbi'))[:2], *sorted(kernels.glob('*.nbc'))[2:]]
    for number, file in enumerate(damaged):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content[:100] if number % 2 else content)
    missing, result, log = run_in(kernels)
    assert missing == len(damaged) == KERNELS and result == pytest.approx(np.pi)
    assert log.count(' is damaged') >= 2, 'both codes, at least'
    assert run_in(kernels)[0] == 0


@pytest.mark.once
@pytest.mark.parametrize('part', ['no file', 'core.geometry.ellipse.unit_circle_overlap-*.nbc'])
def test_kernels_that_others_can_write_to_are_not_used(kernels, part):
    next(kernels.glob(part), kernels).chmod(0o777)
    missing, _, log = run_in(kernels)
    assert missing == KERNELS and 'can write to it' in log


@pytest.mark.once
def test_a_full_disk_costs_only_the_cache(tmp_path):
    limit = 'import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n'
    missing, result, log = run_in(tmp_path, program=limit + PROGRAM)
    assert missing == KERNELS and result == pytest.approx(np.pi)
    assert log.count('WARNING') == 1, 'one message for all kernels'
    assert 'cannot keep' in log and 'set cache_dir' in log
    assert not list(tmp_path.iterdir())


@pytest.mark.once
def test_a_new_folder_begins_with_the_kernels_of_the_installation(kernels, package, tmp_path):
    """This completes a folder that is to be carried to another machine.

    Neither a copy of the package nor a change of an unrelated module outdates the kernels.
    """
    replace_in(package / 'cliploc_ros/errors.py', '_HEAD, _TAIL = 700', '_HEAD, _TAIL = 701')
    shutil.copytree(kernels, package / 'cliploc_ros/__pycache__/kernels')
    preferred = ('from pathlib import Path\n'
                 'from cliploc_ros.core.kernels.compiled import KernelCache\n'
                 f'KernelCache.folder = Path({str(tmp_path / "carried")!r})\n')
    assert run(package=package, program=preferred + PROGRAM)[0] == 0
    shutil.rmtree(package / 'cliploc_ros/__pycache__')
    assert run(package=package, program=preferred + PROGRAM)[0] == 0


# Runs in a separate process, since other tests have called the kernels in this one. Prints the
# number of kernels after the warm-up, and the number that each kind of request added.
WARM_UP = """
import sys
sys.path[:0] = sys.argv[1:3]
from dataclasses import replace
import numpy as np
from cliploc_ros.core.kernels.compiled import COUNTS
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.query import Query
from test_candidates import make_world

landmark_map, observation = make_world(60)
Relocalizer(landmark_map, RelocalizerOptions()).warm_up()
before = COUNTS.total()
print('warm-up', before)
for method in sys.argv[3:]:
    matching, _, algorithm = method.partition('_')
    for up in (None, np.array([0.0, -1.0, 0.0])):
        options = RelocalizerOptions(matching=matching, algorithm=algorithm, iterations=200)
        session = Localizer(Relocalizer(landmark_map, options))
        for number in range(3):
            place = np.eye(4) + 0.1 * number * np.eye(4, k=3)
            session.answer(Query((replace(observation, up_in_camera=up, stamp_ns=number,
                                          odom_from_camera=place),), limit=5, length_s=5.0))
    print(method, COUNTS.total() - before)
"""


@pytest.fixture(scope='module')
def counts():
    here = Path(__file__).parent
    methods = [f'{matching}_{algorithm}' for matching in MATCHINGS for algorithm in ALGORITHMS
               if matching != 'class' or algorithm in ('auto', 'bf', 'ransac')]
    done = subprocess.run(
        [sys.executable, '-c', WARM_UP, str(here), str(here.parent), *methods],
        capture_output=True, text=True, cwd=here.parents[1], timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return {name: int(count) for name, count in map(str.split, done.stdout.splitlines())}


@pytest.mark.full
def test_no_request_compiles_a_kernel(counts):
    assert counts.pop('warm-up') >= 12
    assert {'class_auto', 'clip_prosac', 'hybrid_auto'} < counts.keys()
    assert not any(counts.values()), counts
