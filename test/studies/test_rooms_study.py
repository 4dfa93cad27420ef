# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of real rooms, with the demo's recording and images of another place."""

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from demo import ASSETS

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def asked(tmp_path_factory):
    """Run the study on the demo's room and images without poses; return folder and output."""
    folder = tmp_path_factory.mktemp('rooms')
    shutil.copytree(ASSETS / 'sequence', folder / 'demo')
    (folder / 'elsewhere' / 'images').mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(3):
        coarse = rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / 'elsewhere' / 'images' / f'{number}.jpg'),
                    cv2.resize(coarse, (640, 480)))
    done = subprocess.run(
        [sys.executable, '-m', 'studies.rooms', folder / 'demo', folder / 'elsewhere', '--model',
         ASSETS / 'yolo.onnx', '--kinds', 'in turn', 'phone to robot', '--images', '3',
         '--elsewhere', '2', '--out', folder / 'out'], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / 'out', done.stdout


def test_images_between_the_mapped_ones_are_found(asked):
    outcomes = json.loads((asked[0] / 'outcomes.json').read_text())
    for way, least in (('objects', 0.4), ('both', 0.75)):  # half of the images are mapped
        errors = [outcome['error_m'] for outcome in outcomes
                  if outcome['way'] == way and outcome['known'] == '-'
                  and outcome['kind'] == 'in turn' and outcome['asked'] == 'demo']
        assert len(errors) == 6
        assert np.mean(np.array(errors) < 0.25) >= least
    robot = [outcome['error_m'] for outcome in outcomes
             if outcome['kind'] == 'phone to robot' and outcome['way'] == 'both']
    assert np.mean(np.array(robot) < 0.5) > 0.5


def test_nothing_is_accepted_elsewhere(asked):
    outcomes = json.loads((asked[0] / 'outcomes.json').read_text())
    elsewhere = [outcome for outcome in outcomes if outcome['asked'] == 'elsewhere']
    assert len(elsewhere) == 4 * 2 * 3  # parts, images, ways
    assert not any(outcome['accepted'] for outcome in elsewhere)
