# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's table and growing classes in the demo's world, with the demo's networks."""

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cliploc_ros.offline.evaluation.methods import PAPER_METHODS

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]


def compare(folder, *arguments):
    return subprocess.run(
        [sys.executable, '-m', 'demo.world.compare', '--out', str(folder), *arguments],
        cwd=PROJECT, capture_output=True, text=True, timeout=900, check=False)


@pytest.fixture(scope='module')
def compared(tmp_path_factory):
    """Run a comparison with a short time limit; return its folder and output."""
    folder = tmp_path_factory.mktemp('compare')
    done = compare(folder, '--budget', '0.05', '--trials', '1')
    assert done.returncode == 0, done.stderr
    print('\n' + done.stdout)
    return folder, done.stdout


@pytest.fixture(scope='module')
def limits():
    return yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['demo']['table']


def test_the_networks_know_a_walk_they_never_saw(compared, limits):
    map50, first, third = map(float, re.search(
        r'mAP50 ([.0-9]+); CLIP: top-1 ([.0-9]+), top-3 ([.0-9]+)', compared[1]).groups())
    assert map50 >= limits['map50']
    assert first >= limits['clip_top_1']
    assert third >= limits['clip_top_3']


def test_labels_lead_where_classes_do_not(compared, limits):
    with (compared[0] / 'summary.csv').open() as file:
        rows = {row['method']: row for row in csv.DictReader(file)}
    assert tuple(rows) == (*PAPER_METHODS, 'auto')
    success = {name: float(row['success_0.5m']) for name, row in rows.items()}
    assert success['hybrid_b-prosac'] >= limits['hybrid_b-prosac_at_half_a_metre']
    assert success['hybrid_b-prosac'] > success['class_ransac']
    assert {name for name, row in rows.items() if int(row['wrongly_accepted'])} == set()
