# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``evaluate`` with the demo's networks: several cameras, several floors, keyframes."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rig_bag import write_rig_bag

from cliploc_ros.cli.evaluate import main
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from demo import ASSETS

CAMERAS = ('front', 'left', 'back')


@pytest.fixture
def evaluate(run_here, tmp_path):
    """Run evaluate with the method auto; return its results by method, and its output."""
    def run(*arguments, out=tmp_path, methods=()):
        done = run_here(
            main, '--model', ASSETS / 'yolo.onnx', '--clip-pretrained', ASSETS / 'clip',
            '--trials', 1, '--sweep', '--no-figures', '--workers', 1, '--methods', 'auto',
            *methods, '--out', out, *arguments)
        assert done.returncode == 0, done.stderr
        results = json.loads((out / 'results.json').read_text())
        return {name: [row for row in results if row['method'] == name]
                for name in dict.fromkeys(row['method'] for row in results)}, done.stdout
    return run


def test_cameras_of_an_instant_are_nearer_the_truth_together(evaluate, tmp_path):
    bag = write_rig_bag(tmp_path / 'bag', CAMERAS)
    (one, three) = (evaluate(
        '--bag', bag, '--map', ASSETS / 'map.yaml', '--image', 'image/compressed', '--cameras',
        *cameras)[0]['auto'] for cameras in (CAMERAS[:1], CAMERAS))
    assert len(one) == len(three) == 6
    assert all(row['accepted'] and row['error_m'] < 0.05 for row in three)
    errors = [np.median([row['error_m'] for row in rows]) for rows in (one, three)]
    print(f'\nmedian error: one camera {errors[0]:.3f} m, three {errors[1]:.3f} m')
    assert errors[1] < errors[0]


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return a folder with the demo's wake-ups, and its map with keyframes of the mapping walk.

    Maps of other floors have the same objects at the same and at exchanged places.
    """
    folder = tmp_path_factory.mktemp('walk')
    shutil.copytree(ASSETS / 'sequence', folder / 'sequence')
    shutil.copy(ASSETS / 'map.yaml', folder)
    true = LandmarkMap.from_file(folder / 'map.yaml')
    images = read_folder(ASSETS / 'mapping', FolderOptions(layout='tum'))
    save_layer(layer_path(folder / 'map.yaml'), build_layer(
        images, true, LayerOptions(0.0, 0.0, 300)))
    mixed = true.centers[np.random.default_rng(1).permutation(len(true))]
    for name, centers in (('alike', true.centers), ('other', mixed)):
        write_map(folder / f'{name}.yaml', replace(true, frame_id=name, centers=centers))
    return folder


def test_the_right_floor_is_found_and_equal_floors_are_refused(walk, evaluate):
    found, alike = (evaluate('--tum', walk / 'sequence', '--every', 16, '--map', walk / 'map.yaml',
                             walk / f'{name}.yaml')[0]['auto'] for name in ('other', 'alike'))
    accepted = [result for result in found if result['accepted']]
    assert len(found) == 3 and len(accepted) >= 2
    assert all(result['map'] == 'map' and result['error_m'] < 1.0 for result in accepted)
    assert not any(answer['accepted'] for answer in alike)


def test_the_source_of_each_pose_is_in_table_and_files(walk, evaluate, tmp_path):
    (walk / 'objects.yaml').write_text('objects: {keyframes: false}\n')
    of_images = ('--tum', walk / 'sequence', '--every', 24, '--map', walk / 'map.yaml')
    results, out = evaluate(*of_images, methods=[walk / 'objects.yaml'])
    both, objects = results['auto'], results['objects']
    assert len(both) == len(objects) == 2
    for row in both:
        assert row['keyframe_inliers'] >= 8 and row['keyframes_ms'] > 0.0
        assert row['source'] in ('keyframes', 'both')
    assert [(row['source'], row['keyframe_inliers']) for row in objects] == [('objects', 0)] * 2
    assert min(row['error_m'] for row in both) < 0.03
    sources = ('objects', 'keyframes', 'both')
    counts = ' / '.join(str(sum(row['source'] == name for row in both)) for name in sources)
    assert counts in out and counts in (tmp_path / 'table.md').read_text()
    with (tmp_path / 'summary.csv').open() as file:
        figures = {row['method']: row for row in csv.DictReader(file)}
    assert sum(float(figures['auto'][f'from_{name}']) for name in sources) == pytest.approx(1.0)
    assert float(figures['auto']['keyframe_inliers']) == np.median(
        [row['keyframe_inliers'] for row in both])
    assert figures['objects']['from_both'] == ''
    without, out = evaluate(*of_images, '--no-keyframes', out=tmp_path / 'without')
    assert 'keyframes' not in out.replace('--no-keyframes', '')
    for row, other in zip(without['auto'], objects, strict=True):
        assert row['map_from_camera'] == other['map_from_camera']
