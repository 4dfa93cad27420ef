# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the executable evaluate as a user runs it."""

import csv
import hashlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from capture_folders import copy_walk
from rig_bag import write_rig_bag

from cliploc_ros.cli.evaluate import main
from cliploc_ros.cli.tum_to_bag import main as tum_to_bag
from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.map_recording import MapRecording, save_recording
from cliploc_ros.offline.datasets.observations import load_queries
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from demo import ASSETS

PROJECT = ASSETS.parents[1]
NETWORKS = ('--model', ASSETS / 'yolo.onnx', '--clip-pretrained', ASSETS / 'clip', '--map',
            ASSETS / 'map.yaml')
FIGURES = ('success_over_threshold', 'success_over_iterations', 'top_view',
           'precision_over_recall')
IMAGES = 8
CAMERAS = ('front', 'left', 'back')
TIMEOUT_S = 900.0  # with networks, on a machine under load


def evaluate(*arguments):
    return subprocess.run(
        [sys.executable, '-m', 'cliploc_ros.cli.evaluate', *map(str, arguments)], cwd=PROJECT,
        text=True, capture_output=True, timeout=TIMEOUT_S)


@pytest.fixture
def evaluate_here(run_here):
    """Run evaluate in this process, by default with one worker."""
    return partial(run_here, main, '--workers', 1)


def small(files, *arguments):
    return ('--queries', files / 'queries.npz', '--map', files / 'map.yaml', *arguments)


def results_of(folder):
    """Return the content of results.json without times."""
    return [{key: value for key, value in row.items() if key != 'search_ms'}
            for row in json.loads((folder / 'results.json').read_text())]


def assert_error(done, *named):
    assert done.returncode == 1, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith('error: ')]
    assert len(lines) == 1, done.stderr
    assert 'Traceback' not in done.stderr
    for text in named:
        assert text in lines[0]


@pytest.mark.full
def test_the_papers_table_on_real_queries(shared_data, tmp_path):
    office = shared_data / 'tum_fr3_office'
    done = evaluate('--queries', office / 'queries.npz', '--map', office / 'map.yaml', '--methods',
                    'all', '--trials', 3, '--sweep', 100, '--out', tmp_path)
    assert done.returncode == 0, done.stderr
    print('\n' + done.stdout)
    table = yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['table']
    rows = {f'{matching}_{algorithm}': [float(rate.partition('±')[0])
                                        for rate in rates.split(' / ')]
            for matching, algorithm, rates in re.findall(
                r'^(\w+) +([\w-]+) +(\S+ / \S+ / \S+)', done.stdout, re.MULTILINE)}
    assert tuple(rows) == PAPER_METHODS
    page = (tmp_path / 'report.html').read_text()
    assert page.count('src="data:image/png;base64,') == len(FIGURES)
    assert 'on 52 images' in page
    for method, expected in table['success'].items():
        tolerance = table['tolerance']['bf' if method.endswith('_bf') else 'sampled']
        assert rows[method] == pytest.approx(expected, abs=tolerance + 0.005), method
    assert {path.name for path in tmp_path.iterdir()} == {
        'results.json', 'run.json', 'summary.csv', 'table.md', 'table.tex', 'trajectories',
        'report.html',
        *(f'{name}.{kind}' for name in FIGURES for kind in ('png', 'svg'))}
    for name in FIGURES:
        image = cv2.imread(str(tmp_path / f'{name}.png'))
        assert min(image.shape[:2]) > 400
        assert image.std() > 10


def test_frames_of_a_group_are_fused(files, recording, room, tmp_path, evaluate_here):
    """All frames have one pose. As on a robot at rest, the newest one replaces earlier ones."""
    recorded = tmp_path / 'changed.npz'
    with np.load(files / 'queries.npz') as content:
        np.savez(recorded, **{**content, 'query_group': np.arange(12) // 6,
                              'is_main': np.arange(12) % 6 == 1})
    given = ('--queries', recorded, '--map', files / 'map.yaml', '--methods', 'auto',
             '--no-figures', '--fuse')
    for name, more in (('exact', ('--frames', 'all')),
                       ('noisy', ('--odometry-noise', 0.02, 0.5, '--trials', 2))):
        done = evaluate_here(*given, *more, '--out', tmp_path / name)
        assert done.returncode == 0, done.stderr
    exact, noisy = (results_of(tmp_path / name) for name in ('exact', 'noisy'))
    assert len(exact) == 12 and sum(row['accepted'] for row in exact) >= 6
    assert all(row['error_m'] < 0.2 for row in exact if row['accepted'])
    # each trial has different noise
    first, second = ([row['map_from_camera'] for row in noisy if row['trial'] == trial]
                     for trial in range(2))
    assert first != second and len(first) == len(second) == 2
    assert_error(evaluate_here(*small(files, '--methods', 'auto', '--fuse', '--out', tmp_path)),
                 'neighbouring', 'fuse')


def test_the_files_say_what_was_compared(files, recording, tmp_path, evaluate_here):
    poses = tmp_path / 'theirs.txt'
    truth = recording.frames[0].map_from_camera
    x, y, z, w = quaternion_from_transform(truth)
    for file, quaternion in ((poses, (x, y, z, w)), (tmp_path / 'w.txt', (w, x, y, z))):
        numbers = ' '.join(map(str, [*truth[:3, 3], *quaternion]))
        file.write_text(''.join(f'{second} {numbers}\n' for second in range(100, 109)))
    given = small(files, '--methods', 'class_bf', '--seed', 7, '--no-figures')
    done = evaluate_here(*given, '--poses', f'theirs={poses}', '--out', tmp_path / 'out')
    assert done.returncode == 0, done.stderr
    about = json.loads((tmp_path / 'out/run.json').read_text())
    assert about['sha256'] == {
        str(file): hashlib.sha256(file.read_bytes()).hexdigest()[:12]
        for file in (files / 'queries.npz', files / 'map.yaml', poses)}
    assert (about['queries'], about['landmarks'], about['seed']) == (
        len(recording.frames), len(recording.landmark_ids), 7)
    assert about['similarities'].startswith('unknown')
    assert '--methods class_bf --poses theirs=' in about['options']
    assert '--trials' not in about['options']
    for name in ('report.html', 'table.md', 'table.tex'):
        text = (tmp_path / 'out' / name).read_text()
        assert about['sha256'][str(poses)] in text and 'theirs' in text and '>Figures<' not in text
    assert '<h1>Evaluation of map.yaml</h1>' in (tmp_path / 'out/report.html').read_text()
    assert [row['solved'] for row in results_of(tmp_path / 'out')
            if row['method'] == 'theirs'] == [True] * 9 + [False] * 3
    assert not (tmp_path / 'out/trajectories/theirs.txt').exists()
    for word, named in (('class_bf=x.txt', "called 'class_bf'"), ('theirs', 'NAME=FILE'),
                        ('theirs=missing.txt', 'missing.txt')):
        assert_error(evaluate_here(*given, '--poses', word, '--out', tmp_path / 'none'), named)
    done = evaluate_here(*given, '--poses', f'w={tmp_path}/w.txt', '--out', tmp_path / 'w_first')
    assert ('note: w: poses would fit after one transform (not applied): quaternions are w first '
            '(add this first line') in done.stdout


def test_options_without_effect_are_refused(files, tmp_path, evaluate_here):
    given = small(files, '--methods', 'auto', '--out', tmp_path / 'out')
    assert_error(evaluate_here(*given, '--model', 'yolo.pt', '--no-clip', '--every', 2,
                               '--save-queries', tmp_path / 'q.npz', '--max-gap', 1),
                 '--save-queries, --model, --no-clip, --every, --max-gap: no effect on --queries')


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return every sixth image of the demo's walk, the last without true pose, also as a bag."""
    folder = tmp_path_factory.mktemp('walk')
    assert len(copy_walk(ASSETS / 'sequence', folder / 'tum', 6, with_last=False)) == IMAGES
    assert tum_to_bag([str(folder / 'tum'), str(folder / 'bag')]) == 0
    return folder


METHODS = ('--methods', 'hybrid_b-prosac', 'auto', '--trials', 2, '--sweep', '--no-figures')


@pytest.fixture(scope='module')
def evaluated_bag(walk):
    done = evaluate('--bag', walk / 'bag', *NETWORKS, *METHODS, '--out', walk / 'from_bag',
                    '--save-queries', walk / 'saved.npz', '--workers', 1)
    assert done.returncode == 0, done.stderr
    print('\n' + done.stdout)
    return done


def test_a_bag_a_folder_and_the_saved_queries_say_the_same(walk, evaluated_bag, evaluate_here):
    assert f'skipped without ground truth within 20 ms: 1 of {IMAGES}' in evaluated_bag.stdout
    done = evaluate_here('--tum', walk / 'tum', *NETWORKS, *METHODS, '--out', walk / 'from_tum')
    assert done.returncode == 0, done.stderr
    done = evaluate_here('--queries', walk / 'saved.npz', '--map', ASSETS / 'map.yaml', *METHODS,
                         '--out', walk / 'from_saved')
    assert done.returncode == 0, done.stderr
    results = results_of(walk / 'from_bag')
    assert results == results_of(walk / 'from_saved')
    about = json.loads((walk / 'from_tum/run.json').read_text())
    assert about['detector'] == str(ASSETS / 'yolo.onnx')
    assert about['similarities'] == f'CLIP {ASSETS / "clip"}'
    # a bag's quaternions are rounded once more
    for result, other in zip(results, results_of(walk / 'from_tum'), strict=True):
        for name in ('error_m', 'error_deg', 'nees', 'confidence'):
            assert result.pop(name) == pytest.approx(other.pop(name), abs=1e-6)
        assert result == other
    results = results_of(walk / 'from_bag')
    queries = len(load_queries(walk / 'saved.npz').frames)
    assert queries == IMAGES - 1
    assert len(results) == (2 + 1) * queries  # auto draws no samples, and runs one trial
    right = [row for row in results if row['error_m'] is not None and row['error_m'] < 0.5]
    assert len(right) > 0.9 * len(results)


def test_networks_run_once_and_a_map_of_the_same_images_is_noted(walk, evaluated_bag,
                                                                evaluate_here, caplog):
    own = walk / 'own.yaml'
    shutil.copy(ASSETS / 'map.yaml', own)
    cache = Path(re.search(r'(?:wrote|earlier run:) (\S+\.npz)', evaluated_bag.stderr)[1])
    assert [path.name for path in walk.glob('*.npz')] == ['saved.npz'] and not [*walk.glob('.*')]
    before = cache.stat().st_mtime_ns
    given = (*NETWORKS[:-1], own, '--methods', 'clip_b-prosac', '--trials', 1, '--no-figures')
    for source, is_noted in (('bag', True), ('tum', False)):
        save_recording(own, MapRecording(cache, walk / source))
        done = evaluate_here('--bag', walk / 'bag', *given, '--out', walk / f'on_{source}')
        assert done.returncode == 0, done.stderr
        assert ('built from' in done.stdout) is is_noted
    assert str(cache) in caplog.text and cache.stat().st_mtime_ns == before
    cache.write_bytes(b'rubbish')
    done = evaluate_here('--bag', walk / 'bag', *given, '--out', walk / 'once_more')
    assert done.returncode == 0 and 'recording again' in caplog.text
    assert results_of(walk / 'once_more') == results_of(walk / 'on_tum')


# ---- several cameras and floors, keyframes ------------------------------------------------------

@pytest.fixture
def results_by_method(evaluate_here, tmp_path):
    """Run evaluate with the method auto; return its results by method, and its output."""
    def run(*arguments, out=tmp_path, methods=()):
        done = evaluate_here(*NETWORKS[:4], '--trials', 1, '--sweep', '--no-figures', '--methods',
                             'auto', *methods, '--out', out, *arguments)
        assert done.returncode == 0, done.stderr
        results = json.loads((out / 'results.json').read_text())
        return {name: [row for row in results if row['method'] == name]
                for name in dict.fromkeys(row['method'] for row in results)}, done.stdout
    return run


def test_cameras_of_an_instant_are_nearer_the_truth_together(results_by_method, tmp_path):
    bag = write_rig_bag(tmp_path / 'bag', CAMERAS)
    (one, three) = (results_by_method(
        '--bag', bag, '--map', ASSETS / 'map.yaml', '--image', 'image/compressed', '--cameras',
        *cameras)[0]['auto'] for cameras in (CAMERAS[:1], CAMERAS))
    assert len(one) == len(three) == 6
    assert all(row['accepted'] and row['error_m'] < 0.05 for row in three)
    errors = [np.median([row['error_m'] for row in rows]) for rows in (one, three)]
    print(f'\nmedian error: one camera {errors[0]:.3f} m, three {errors[1]:.3f} m')
    assert errors[1] < errors[0]


@pytest.fixture(scope='module')
def floors(tmp_path_factory):
    """Return a folder with the demo's wake-ups, and its map with keyframes of the mapping walk.

    Maps of other floors have the same objects at the same and at exchanged places.
    """
    folder = tmp_path_factory.mktemp('floors')
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


def test_the_right_floor_is_found_and_equal_floors_are_refused(floors, results_by_method):
    found, alike = (results_by_method(
        '--tum', floors / 'sequence', '--every', 16, '--map', floors / 'map.yaml',
        floors / f'{name}.yaml')[0]['auto'] for name in ('other', 'alike'))
    accepted = [result for result in found if result['accepted']]
    assert len(found) == 3 and len(accepted) >= 2
    assert all(result['map'] == 'map' and result['error_m'] < 1.0 for result in accepted)
    assert not any(answer['accepted'] for answer in alike)


def test_the_source_of_each_pose_is_in_table_and_files(floors, results_by_method, tmp_path):
    (floors / 'objects.yaml').write_text('objects: {keyframes: false}\n')
    of_images = ('--tum', floors / 'sequence', '--every', 24, '--map', floors / 'map.yaml')
    results, out = results_by_method(*of_images, methods=[floors / 'objects.yaml'])
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
    without, out = results_by_method(*of_images, '--no-keyframes', out=tmp_path / 'without')
    assert 'keyframes' not in out.replace('--no-keyframes', '')
    for row, other in zip(without['auto'], objects, strict=True):
        assert row['map_from_camera'] == other['map_from_camera']
