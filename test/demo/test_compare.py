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


def test_the_networks_know_a_walk_they_never_saw_and_labels_lead_where_classes_do_not(tmp_path):
    limits = yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['demo']['table']
    done = subprocess.run(
        [sys.executable, '-m', 'demo.world.compare', '--out', str(tmp_path), '--budget', '0.05',
         '--trials', '1'], cwd=PROJECT, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    print('\n' + done.stdout)
    map50, first, third = map(float, re.search(
        r'mAP50 ([.0-9]+); CLIP: top-1 ([.0-9]+), top-3 ([.0-9]+)', done.stdout).groups())
    assert map50 >= limits['map50']
    assert first >= limits['clip_top_1'] and third >= limits['clip_top_3']
    with (tmp_path / 'summary.csv').open() as file:
        rows = {row['method']: row for row in csv.DictReader(file)}
    assert tuple(rows) == (*PAPER_METHODS, 'auto')
    success = {name: float(row['success_0.5m']) for name, row in rows.items()}
    assert success['hybrid_b-prosac'] >= limits['hybrid_b-prosac_at_half_a_metre']
    assert success['hybrid_b-prosac'] > success['class_ransac']
    assert {name for name, row in rows.items() if int(row['wrongly_accepted'])} == set()
