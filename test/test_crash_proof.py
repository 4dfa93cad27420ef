# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A run of tests in parallel comes to its end although a worker dies."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.needs('xdist'), pytest.mark.needs('pytest_rerunfailures')]

FOLDER = Path(__file__).parent
FILE = """
import os
from pathlib import Path

import pytest

@pytest.mark.parametrize('number', range(4))
def test_file_{file}(number):
    died = Path(__file__).with_name('died')
    if ({file}, number) == {deadly} and ({always} or not died.exists()):
        died.touch()
        os._exit(3)
"""


def run(folder, deadly, always=False):
    """Run 5 files of 4 tests on two workers, with this project's conftest.py."""
    for name in ('conftest.py', 'crash_proof.py'):
        (folder / name).symlink_to(FOLDER / name)
    for file in range(5):
        (folder / f'test_{file}.py').write_text(
            FILE.format(file=file, deadly=deadly, always=always))
    return subprocess.run([sys.executable, '-m', 'pytest', '-n', '2', '--dist', 'loadfile',
                           '--no-loadscope-reorder', '-p', 'no:cacheprovider', folder],
                          text=True, capture_output=True, timeout=120, cwd=folder)


@pytest.mark.parametrize('deadly', [(2, 1), (4, 3)])
def test_the_test_at_which_a_worker_died_runs_again(tmp_path, deadly):
    done = run(tmp_path, deadly)
    assert 'ran 20: 20 passed, 0 failed' in done.stdout, done.stdout
    assert f'ran again: test_{deadly[0]}.py::test_file_{deadly[0]}[{deadly[1]}]' in done.stdout
    assert done.returncode == 0


@pytest.mark.parametrize('deadly', [(1, 2), (4, 3)])
def test_a_deadly_test_fails_alone(tmp_path, deadly):
    done = run(tmp_path, deadly, always=True)
    assert 'ran 20: 19 passed, 1 failed' in done.stdout, done.stdout
    assert "worker 'gw" in done.stdout
    assert done.returncode == 1
