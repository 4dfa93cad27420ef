# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark runs, and its plain loop gives the same result as the kernel."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]


@pytest.mark.clock
def test_the_kernel_is_two_orders_faster_than_a_plain_loop_and_as_good():
    done = subprocess.run([sys.executable, '-m', 'studies.speed', 'search', '--landmarks',
                           '100', '1000'], capture_output=True, text=True, cwd=PROJECT, check=True)
    print(f'\n{done.stdout}')
    ratio = float(re.search(r'(\d+) times as long', done.stdout).group(1))
    ours, plain = re.search(r'score ([\d.]+), plain ([\d.]+)', done.stdout).groups()
    assert re.search(r'^\| 1,000 ', done.stdout, re.MULTILINE)
    assert 'times the tenth' in done.stdout
    assert ratio > 120
    assert float(ours) == pytest.approx(float(plain), abs=5e-3)
