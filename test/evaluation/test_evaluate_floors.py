# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real detections and CLIP on the demo's floor, searched together with other floors."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.cli.evaluate import main
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from demo import ASSETS

NETWORKS = ('--model', ASSETS / 'yolo.onnx', '--clip-pretrained', ASSETS / 'clip', '--methods',
            'auto', '--trials', 1, '--no-figures', '--workers', 1)


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return the demo's walk, and maps: its floor, an equal floor, and the objects elsewhere."""
    folder = tmp_path_factory.mktemp('floors')
    shutil.copytree(ASSETS / 'sequence', folder / 'sequence')
    true = LandmarkMap.from_file(ASSETS / 'map.yaml')
    mixed = true.centers[np.random.default_rng(1).permutation(len(true))]
    for name, centers in (('ground', true.centers), ('alike', true.centers), ('other', mixed)):
        write_map(folder / f'{name}.yaml', replace(true, frame_id=name, centers=centers))
    return folder


def evaluate(folder, *names):
    """Return the results of three images in some maps."""
    out, maps = folder / '_'.join(names), [folder / f'{name}.yaml' for name in names]
    assert main([str(word) for word in ('--tum', folder / 'sequence', '--every', 16, *NETWORKS,
                                        '--map', *maps, '--out', out)]) == 0
    return json.loads((out / 'results.json').read_text())


def test_the_right_floor_is_found_and_equal_floors_are_refused(walk):
    found = evaluate(walk, 'ground', 'other')
    accepted = [result for result in found if result['accepted']]
    assert len(found) == 3 and len(accepted) >= 2
    assert all(result['map'] == 'ground' and result['error_m'] < 1.0 for result in accepted)
    alike = evaluate(walk, 'ground', 'alike')
    assert not any(answer['accepted'] for answer in alike)
