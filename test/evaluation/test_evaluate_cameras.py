# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recording of several cameras: images of an instant are localized together."""

import json
from pathlib import Path

import numpy as np
import pytest
from rig_bag import write_rig_bag

from cliploc_ros.cli.evaluate import main as evaluate

ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
NETWORKS = ('--model', ASSETS / 'yolo.onnx', '--clip-pretrained', ASSETS / 'clip', '--map',
            ASSETS / 'map.yaml')
CAMERAS = ('front', 'left', 'back')


@pytest.fixture(scope='module')
def rig_bag(tmp_path_factory):
    """Record three cameras of the demo's rig in one bag."""
    return write_rig_bag(tmp_path_factory.mktemp('rig') / 'bag', CAMERAS)


def run(rig_bag, out, *arguments):
    return evaluate(list(map(str, (
        '--bag', rig_bag, *NETWORKS, '--methods', 'auto', '--trials', 1, '--sweep',
        '--no-figures', '--workers', 1, '--image', 'image/compressed', '--out', out,
        *arguments))))


def results_of(folder):
    return json.loads((folder / 'results.json').read_text())


def test_together_they_are_nearer_the_truth(rig_bag, tmp_path):
    assert run(rig_bag, tmp_path / 'one', '--cameras', 'front') == 0
    assert run(rig_bag, tmp_path / 'three', '--cameras', *CAMERAS) == 0
    one, three = (results_of(tmp_path / name) for name in ('one', 'three'))
    assert len(one) == len(three) == 6
    assert all(row['accepted'] and row['error_m'] < 0.05 for row in three)
    errors = [np.median([row['error_m'] for row in rows]) for rows in (one, three)]
    print(f'\nmedian error: one camera {errors[0]:.3f} m, three {errors[1]:.3f} m')
    assert errors[1] < errors[0]
