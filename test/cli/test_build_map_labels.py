# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""build_map labels a map with the demo's CLIP, and stores image embeddings next to the map."""

import contextlib
import io
import shutil
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.cli.build_map import main
from cliploc_ros.core.map.landmark_embeddings import load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import load_observations

ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
CLIP = ('--clip-pretrained', ASSETS / 'clip')
# a short walk shows objects from one side only
SHORT = ('--min-baseline', '0.5', '--no-check')
IMAGES = 10
COLOURS = ('red', 'orange', 'yellow', 'green', 'blue', 'purple', 'pink', 'brown', 'black', 'white')


def build(*args):
    return main([str(arg) for arg in (*args, *SHORT)])


@pytest.fixture(scope='module', autouse=True)
def own_cache(tmp_path_factory):
    """Provide an encoder cache, so that phrases are encoded once in this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('XDG_CACHE_HOME', str(tmp_path_factory.mktemp('cache')))
        yield


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return the first images of the demo's walk."""
    folder = tmp_path_factory.mktemp('walk') / 'tum'
    shutil.copytree(ASSETS / 'sequence', folder)
    rows = [row for row in (folder / 'rgb.txt').read_text().splitlines() if row[0] != '#']
    (folder / 'rgb.txt').write_text('\n'.join(rows[:IMAGES]) + '\n')
    return folder


@pytest.fixture(scope='module')
def observations(walk):
    """Return recorded observations of the walk, and a map labelled with the shipped vocabulary."""
    file = walk.parent / 'walk.npz'
    with contextlib.redirect_stdout(io.StringIO()):
        code = build('--tum', walk, '--model', ASSETS / 'yolo.onnx', *CLIP, '--keyframes', 0, 0,
                     '--record-to', file, '--out', walk.parent / 'shipped.yaml')
    assert code == 0
    return file


def true_labels(built):
    """Return the true label of each landmark at the place of an object, otherwise ''."""
    true = LandmarkMap.from_file(ASSETS / 'map.yaml')
    distances = np.linalg.norm(built.centers[:, None] - true.centers, axis=2)
    return [true.labels[row] if distance < 0.15 else ''
            for row, distance in zip(distances.argmin(axis=1), distances.min(axis=1),
                                     strict=True)]


def first_colour(label):
    return next((word for word in label.split() if word in COLOURS), None)


def test_labels_from_the_shipped_vocabulary(observations):
    path = observations.with_name('shipped.yaml')
    built = LandmarkMap.from_file(path)
    assert len(built) >= 8
    pairs = [(first_colour(label), first_colour(true))
             for label, true in zip(built.labels, true_labels(built), strict=True) if true]
    assert len(pairs) >= 6
    assert np.mean([found == meant for found, meant in pairs]) >= 0.6
    for label, details in zip(built.labels, built.details, strict=True):
        assert details.labels[0][0] == label
        assert len(details.labels) == 6
    embeddings = load_embeddings_of_map(path, built.landmark_ids)
    assert embeddings.encoder_key == load_observations(observations).encoder_key
    assert embeddings.is_known.all()
    assert embeddings.means.shape == (len(built), 128)


def test_phrases_of_a_user(observations, tmp_path, capsys):
    """A pattern that the shipped vocabulary lacks."""
    words = tmp_path / 'words.yaml'
    classes = {class_id.split('_')[0] for class_id in LandmarkMap.from_file(
        observations.with_name('shipped.yaml')).class_ids}
    words.write_text(''.join(
        f"{name}:\n  phrases: ['a {{colour}} {name} {{pattern}}', 'a {{colour}} {name}']\n"
        f"  colour: [{', '.join(COLOURS)}]\n  pattern: ['with {{second}} bands']\n"
        for name in sorted(classes)))
    assert build('--observations', observations, *CLIP, '--vocabulary', words,
                 '--out', tmp_path / 'm.yaml') == 0
    built = LandmarkMap.from_file(tmp_path / 'm.yaml')
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith('note:')]
    assert [note[:18] for note in notes] == ['note: no keyframes']
    assert any('bands' in text for details in built.details for text, _ in details.labels)
