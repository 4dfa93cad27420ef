# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``build_map --update`` in the demo's world: rendered images, real YOLO and CLIP; simulated."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.cli import build_map
from cliploc_ros.core.map.landmark_embeddings import load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from demo import ASSETS

ROOM = Path(__file__).parent / 'changed_room'
CHANGES = json.loads((ROOM / 'changes.json').read_text())
CLIP = ['--clip-model', ASSETS / 'clip.json', '--clip-pretrained', ASSETS / 'clip.safetensors']


def update(folder, *options):
    """Update the map of a folder by the executable's own function; return the exit code."""
    return build_map.main([str(one) for one in (
        '--observations', ROOM / 'after.npz', '--update', folder / 'map.yaml', '--no-check',
        '--out', folder / 'map.yaml', '--report', folder / 'report.json', *CLIP, *options)])


@pytest.fixture(scope='module')
def updated(tmp_path_factory):
    """The folder of a map that was updated in place."""
    folder = tmp_path_factory.mktemp('changed')
    for name in ('map.yaml', 'map.embeddings.npz'):
        shutil.copyfile(ROOM / name, folder / name)
    assert update(folder) == 0
    return folder


@pytest.fixture(scope='module')
def report(updated):
    return json.loads((updated / 'report.json').read_text())


def test_all_nine_changes_are_reported_and_nothing_else(report):
    def names(kind):
        return {one['landmark_id'] for one in report[kind]}

    assert names('moved') == set(CHANGES['moved'])
    assert names('missing') == set(CHANGES['removed'])
    assert len(report['new']) == len(CHANGES['new']) == 3
    assert sorted(one['class_id'] for one in report['new']) == sorted(
        name.split('_')[0] for name in CHANGES['new'])
    assert len(report['confirmed']) == 60 - 4 - 2
    assert report['not_observed'] == []
    assert all('seen in 0' in one['evidence'] for one in report['missing'])
    assert all(one['rivals'] == [] and one['distance_m'] > 1.0 for one in report['moved'])


def test_the_map_holds_what_is_there_now(updated, report):
    old, new = LandmarkMap.from_file(ROOM / 'map.yaml'), LandmarkMap.from_file(
        updated / 'map.yaml')
    kept = [name for name in old.landmark_ids if name not in CHANGES['removed']]
    assert new.landmark_ids[:len(kept)] == tuple(kept)
    labels = dict(zip(new.landmark_ids, new.labels, strict=True))
    for name, label in zip(old.landmark_ids, old.labels, strict=True):
        assert labels.get(name, label) == label
    # pairs exchanged their places
    places = dict(zip(old.landmark_ids, old.centers, strict=True))
    for name in CHANGES['moved']:
        here = new.centers[new.landmark_ids.index(name)]
        way = min(np.linalg.norm((here - places[other])[:2])
                  for other in CHANGES['moved'] if other != name)
        assert way < 0.1
    # a person's ellipsoids stay
    stayed = [name for name in kept if name not in CHANGES['moved']]
    for name in stayed:
        np.testing.assert_array_equal(new.centers[new.landmark_ids.index(name)], places[name])
    assert {one['landmark_id'] for one in report['new']} == set(new.landmark_ids[len(kept):])


def test_new_landmarks_have_phrases_and_all_have_embeddings(updated, report):
    new = LandmarkMap.from_file(updated / 'map.yaml')
    embeddings = load_embeddings_of_map(updated / 'map.yaml', new.landmark_ids)
    assert embeddings.is_known.all()
    old = load_embeddings_of_map(ROOM / 'map.yaml', new.landmark_ids)
    kept = old.is_known
    np.testing.assert_array_equal(embeddings.means[kept], old.means[kept])
    for one in report['new']:
        row = new.landmark_ids.index(one['landmark_id'])
        assert one['label'] == new.labels[row]
        assert len(new.details[row].labels) == 6 or one['label'] == one['class_id']


def test_a_recording_of_another_place_leaves_the_map_alone(tmp_path, capsys):
    old = LandmarkMap.from_file(ROOM / 'map.yaml')
    rng = np.random.default_rng(0)
    mixed = old.select(rng.permutation(len(old)))
    write_map(tmp_path / 'map.yaml', LandmarkMap(
        old.frame_id, old.landmark_ids, mixed.labels, mixed.class_ids, old.centers,
        mixed.semi_axes, mixed.quats_xyzw))
    before = (tmp_path / 'map.yaml').read_bytes()
    assert update(tmp_path) == 1
    assert 'does not belong' in capsys.readouterr().err
    assert (tmp_path / 'map.yaml').read_bytes() == before
    assert 'does not belong' in json.loads((tmp_path / 'report.json').read_text())['failure']


@pytest.mark.parametrize(('text', 'options', 'message'), [
    (None, (), 'no such file'), ('', (), 'map'), ('a: [1', (), 'map.yaml'),
    ((ROOM / 'map.yaml').read_text(), ('--refine-mount',), '--refine-mount')])
def test_an_unusable_old_map_and_wrong_options_are_refused_before_the_work(
        tmp_path, capsys, text, options, message):
    if text is not None:
        (tmp_path / 'map.yaml').write_text(text)
    assert update(tmp_path, *options) == 1
    assert message in capsys.readouterr().err.lower()
