# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``evaluate`` with a map that has keyframes reports the source of each pose."""

import csv
import json
import shutil
import signal

import numpy as np
import pytest

from cliploc_ros.cli.evaluate import main
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from demo import ASSETS

NETWORKS = ('--model', ASSETS / 'yolo.onnx', '--clip-pretrained', ASSETS / 'clip')
QUICK = ('--trials', 1, '--sweep', '--no-figures', '--workers', 1)


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return a folder with the demo's wake-ups, its map, and keyframes of its mapping walk."""
    folder = tmp_path_factory.mktemp('walk')
    shutil.copytree(ASSETS / 'sequence', folder / 'sequence')
    shutil.copy(ASSETS / 'map.yaml', folder)
    images = read_folder(ASSETS / 'mapping', FolderOptions(layout='tum'))
    save_layer(layer_path(folder / 'map.yaml'), build_layer(
        images, LandmarkMap.from_file(folder / 'map.yaml'), LayerOptions(0.0, 0.0, 300)))
    (folder / 'objects.yaml').write_text('objects: {keyframes: false}\n')
    return folder


@pytest.fixture
def evaluate(capsys):
    handler = signal.getsignal(signal.SIGTERM)

    def run(*arguments):
        code = main([*map(str, arguments)])
        return (code, *capsys.readouterr())
    yield run
    signal.signal(signal.SIGTERM, handler)


def of_images(folder, *arguments):
    return ('--tum', folder / 'sequence', '--every', 24, '--map', folder / 'map.yaml', *NETWORKS,
            *QUICK, *arguments)


def results_of(folder, method):
    return [row for row in json.loads((folder / 'results.json').read_text())
            if row['method'] == method]


def test_the_source_of_each_pose_is_in_table_and_files(walk, evaluate, tmp_path):
    code, out, err = evaluate(*of_images(
        walk, '--methods', 'auto', walk / 'objects.yaml', '--out', tmp_path))
    assert code == 0, err
    both, objects = (results_of(tmp_path, name) for name in ('auto', 'objects'))
    assert len(both) == len(objects) == 2
    for row in both:
        assert row['keyframe_inliers'] >= 8 and row['keyframes_ms'] > 0.0
        assert row['source'] in ('keyframes', 'both')
    assert [row['source'] for row in objects] == ['objects'] * 2
    assert [row['keyframe_inliers'] for row in objects] == [0, 0]
    assert min(row['error_m'] for row in both) < 0.03
    counts = ' / '.join(str(sum(row['source'] == name for row in both))
                        for name in ('objects', 'keyframes', 'both'))
    for text in (out, (tmp_path / 'table.md').read_text()):
        assert counts in text
    with (tmp_path / 'summary.csv').open() as file:
        figures = {row['method']: row for row in csv.DictReader(file)}
    assert sum(float(figures['auto'][f'from_{name}'])
               for name in ('objects', 'keyframes', 'both')) == pytest.approx(1.0)
    assert float(figures['auto']['keyframe_inliers']) == np.median(
        [row['keyframe_inliers'] for row in both])
    assert figures['objects']['from_both'] == ''
    code, out, err = evaluate(*of_images(
        walk, '--methods', 'auto', '--no-keyframes', '--out', tmp_path / 'without'))
    assert code == 0, err
    assert 'keyframes' not in out.replace('--no-keyframes', '')
    for row, other in zip(results_of(tmp_path / 'without', 'auto'), objects, strict=True):
        assert row['map_from_camera'] == other['map_from_camera']
