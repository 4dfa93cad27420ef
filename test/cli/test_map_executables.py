# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executables build_map, check_map and import_map, mostly on observations or maps alone."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from capture_folders import ASSETS, WALK
from foreign_maps import table_text
from scene import make_room

from cliploc_ros.cli import build_map, check_map, import_map
from cliploc_ros.cli.options import layer_options
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping import building
from cliploc_ros.offline.mapping.check import checking
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions

FAST = ('--positions', 4, '--headings', 2)


@pytest.fixture(scope='module')
def observations(shared_data, tmp_path_factory):
    """Return every sixteenth frame of the office: enough for a map, and fast."""
    whole = load_observations(shared_data / 'tum_fr3_office' / 'observations.npz')
    path = tmp_path_factory.mktemp('office') / 'office.npz'
    save_observations(path, whole.select_frames(range(0, len(whole), 16)))
    return path


# ---- build_map ----------------------------------------------------------------------------------
def test_builds_a_map_and_a_report(run_here, observations, tmp_path):
    out, report = tmp_path / 'office.yaml', tmp_path / 'office.json'
    old_layer = tmp_path / 'office.keyframes.npz'
    old_layer.touch()
    done = run_here(build_map.main, '--no-check', '--observations', observations, '--out', out,
                    '--report', report, '--frame-id', 'world')
    assert done.returncode == 0, done.stderr
    assert not old_layer.exists() and f'removed {old_layer}' in done.stdout
    built = LandmarkMap.from_file(out)
    assert built.frame_id == 'world' and len(built) > 30
    assert all(details.support >= 3 for details in built.details)
    found = json.loads(report.read_text())
    assert found['landmarks'] == len(built) and found['explained'] > 0.85
    assert f'{len(built)} landmarks' in done.stdout and ' 162 frames' in done.stdout
    assert 'left out:' in done.stdout and f'wrote {out}' in done.stdout


def test_an_existing_map_stays_when_building_fails(run_here, observations, tmp_path):
    old, cut, report = tmp_path / 'old.yaml', tmp_path / 'cut.npz', tmp_path / 'failed.json'
    old.write_text('precious')
    cut.write_bytes(observations.read_bytes()[:20_000])
    for options, named in ((('--observations', cut), f'error: {cut}: '),
                           (('--observations', observations, '--every', 400), 'at least 3 '),
                           (('--observations', observations, '--min-baseline', 179, '--report',
                             report), 'error: ')):
        done = run_here(build_map.main, *options, '--no-check', '--out', old)
        assert done.returncode == 1 and named in done.stderr
    found = json.loads(report.read_text())
    assert found['failure'] in done.stderr and len(found['left_out']) > 9
    assert old.read_text() == 'precious'
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'cut.npz', 'failed.json', 'old.yaml']


@pytest.mark.parametrize(('declined', 'why'), [
    ('--no-keyframe-layer', ''), ('--every=2', 'no keyframes with --every')])
def test_keyframes_that_are_declined_or_impossible(declined, why):
    layer, note = layer_options(build_map.make_parser().parse_args(
        ['--tum', str(WALK), declined, '--out', 'a.yaml']))
    assert layer is None and note.startswith(why) and bool(note) == bool(why)


# ---- check_map ----------------------------------------------------------------------------------
@pytest.fixture
def room_file(tmp_path):
    write_map(tmp_path / 'room.yaml', make_room())
    return tmp_path / 'room.yaml'


@pytest.mark.parametrize(('args', 'named'), [
    (('{folder}/missing.yaml',), 'missing.yaml'), (('{room}', '--observations', '{room}'), 'npz'),
    (('{room}', '--images', '{folder}'), '--observations')])
def test_what_to_correct_is_named(run_here, room_file, tmp_path, args, named):
    done = run_here(check_map.main, *(word.format(folder=tmp_path, room=room_file)
                                      for word in args), '--out', tmp_path / 'out')
    assert done.returncode == 1
    assert done.stderr.startswith('error: ') and named in done.stderr
    assert not (tmp_path / 'out/check.json').exists()


def test_the_office_passes_but_for_its_doubles(run_here, shared_data, tmp_path):
    office = shared_data / 'tum_fr3_office'
    done = run_here(check_map.main, office / 'map.yaml', '--observations',
                    office / 'observations.npz', '--every', 20, '--frames', 10,
                    '--out', tmp_path, *FAST)
    assert done.returncode == 0, done.stdout + done.stderr
    checked = json.loads((tmp_path / 'check.json').read_text())
    assert checked['recording']['held_out']['explained'] > 0.8
    # all images show these two pairs; a third one, a spoon in a cup, has few boxes here
    doubles = [{overlap['first'], overlap['second']} for overlap in checked['overlaps']
               if overlap['is_duplicate']]
    assert len(doubles) == 3
    assert {'teddy_bear_1', 'chair_3'} in doubles and {'refrigerator_1', 'book_5'} in doubles


# ---- import_map ---------------------------------------------------------------------------------
@pytest.fixture(scope='module')
def office(shared_data):
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office' / 'map.yaml')


@pytest.fixture(scope='module')
def table(office, tmp_path_factory):
    """Return the office as another system may store it: 5 cm off on each axis, and too large."""
    rng = np.random.default_rng(0)
    text = table_text(LandmarkMap(
        'map', office.landmark_ids, office.labels, office.class_ids,
        office.centers + rng.normal(0.0, 0.05, office.centers.shape), office.semi_axes * 1.3,
        office.quats_xyzw))
    path = tmp_path_factory.mktemp('theirs') / 'theirs.csv'
    path.write_text(text + 'ghost,a cup,cup,0,0,9,.1,.1,.1,0,0,0,1\nthin,,cup,0,0,9,.1,.1,0.0001,'
                    '0,0,0,1\n')
    return path


def test_refits_to_a_recording(run_here, office, table, observations, tmp_path):
    out, report = tmp_path / 'map.yaml', tmp_path / 'map.json'
    done = run_here(import_map.main, table, '--refit', observations, '--out', out,
                    '--report', report, '--frame-id', 'world')
    assert done.returncode == 0, done.stderr
    found = LandmarkMap.from_file(out)
    assert found.frame_id == 'world' and f'{len(found)} of 41 ' in done.stdout
    places = dict(zip(office.landmark_ids, office.centers, strict=True))
    errors_m = [np.linalg.norm(center - places[name])
                for name, center in zip(found.landmark_ids, found.centers, strict=True)]
    print(f'{len(found)} landmarks, median error {np.median(errors_m) * 100:.1f} cm')
    assert len(found) >= 30 and np.median(errors_m) < 0.03
    assert {detail.source for detail in found.details} == {'import_map csv theirs.csv'}
    assert all(detail.support >= 3 and detail.position_sigma < 0.1 and detail.shared_sigma is None
               for detail in found.details)
    left_out = {one['landmark_id']: one['reason']
                for one in json.loads(report.read_text())['left_out']}
    assert len(left_out) == 42 - len(found)
    assert 'semi-axes' in left_out['thin'] and 'ghost' in left_out


def test_keeps_what_cannot_be_fitted_where_asked_for(run_here, table, observations, tmp_path):
    out = tmp_path / 'map.yaml'
    assert run_here(import_map.main, table, '--refit', observations, '--out', out,
                    '--keep-unsupported').returncode == 0
    found = LandmarkMap.from_file(out)
    row = found.landmark_ids.index('ghost')
    assert found.centers[row].tolist() == [0.0, 0.0, 9.0]
    kept = found.details[row]
    assert (kept.support, kept.position_sigma, kept.shared_sigma, kept.shared_sigma_deg) == (
        None, 0.05, 0.05, 1.0)


# ---- recordings without landmarks, with poor ones or with moving objects ------------------------
def test_a_map_of_keyframes_alone(shared_data, tmp_path, capsys):
    """There is no landmark, but the images still localize the camera."""
    folder, out = shared_data / 'tum_fr3_office', tmp_path / 'office.yaml'
    given = ['--tum', str(folder), '--no-clip', '--min-viewpoints', '16', '--out', str(out),
             '--model', str(ASSETS / 'yolo.onnx'), '--no-check',
             '--record-to', str(tmp_path / 'seen.npz')]
    assert build_map.main(given) == 0
    assert 'no landmark from' in capsys.readouterr().out
    known = LandmarkMap.from_file(out)
    assert len(known) == 0
    layer = load_layer_of_map(layer_path(out), known)
    localizer = Localizer(Relocalizer(known, RelocalizerOptions()), KeyframeLocalizer(layer))
    frames = read_folder(folder, FolderOptions(layout='tum'))
    for boxes in (np.empty((0, 4)), np.array([[100.0, 100.0, 200.0, 200.0]])):
        frame = next(frames.select([5]).read())
        seen = Detections(boxes, ('cup',) * len(boxes), np.full(len(boxes), 0.9))
        found = localizer.answer(Query((Observation(frame.camera, seen),), (frame.image_rgb,)))
        assert found.accepted and found.source == 'keyframes'
        assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.05
    assert check_map.main([str(out), '--frames', '4', *map(str, FAST)]) == 1
    assert 'verdict: keyframes only: ' in capsys.readouterr().out
    report = tmp_path / 'today.json'
    assert build_map.main([*given, '--update', str(out), '--report', str(report)]) == 0
    assert {fate['fate'] for fate in json.loads(report.read_text())['keyframes']} == {'confirmed'}
    assert f'keyframes: {len(layer)} confirmed, 0 retired, 0 added' in capsys.readouterr().out
    assert len(load_layer_of_map(layer_path(out), LandmarkMap.from_file(out))) == len(layer)
    assert build_map.main([*given, '--no-keyframe-layer']) == 1


def test_a_poor_map_takes_no_place(observations, tmp_path, capsys):
    """Poses of other images: the map is written under another name, and the exit code is 1."""
    rng, few = np.random.default_rng(0), load_observations(observations)
    poses = few.map_from_camera.copy()
    poses[:, :3, 3] += rng.normal(0.0, 1.2, (len(poses), 3))
    save_observations(tmp_path / 'off.npz', replace(few, map_from_camera=poses))
    out = tmp_path / 'office.yaml'
    out.write_text('the map before')
    code = build_map.main(['--observations', str(tmp_path / 'off.npz'), '--no-clip', '--no-joint',
                           '--no-check', '--out', str(out)])
    assert code == 1 and out.read_text() == 'the map before'
    assert 'refused: ' in capsys.readouterr().out
    assert len(LandmarkMap.from_file(tmp_path / 'office.refused.yaml')) > 0


def test_what_moves_is_no_landmark(observations, tmp_path, capsys):
    """The bottles are persons here: none is mapped unless the list allows it."""
    few = load_observations(observations)
    names = tuple('person' if name == 'bottle' else name for name in few.class_names)
    crowded = replace(few, class_names=names)
    plain = building.build_map(crowded, MappingOptions(moving_classes=())).landmark_map
    assert 'person' in plain.class_ids
    built = building.build_map(crowded)
    assert 'person' not in built.landmark_map.class_ids
    assert any(re.search('of .*person.* left out', note) for note in built.report.notes)
    report = checking.check_map(plain, crowded, CheckOptions(
        folds=2, frames=1, max_positions=1, headings=1))
    faults = {landmark.landmark_id: landmark for landmark in report.landmarks}
    assert all(faults[name].severity >= 1.0 for name, kind in zip(
        plain.landmark_ids, plain.class_ids, strict=True) if kind == 'person')
    assert build_map.main(['--observations', str(observations), '--no-clip', '--no-check',
                           '--moving', 'Bottle, cup, persn', '--out',
                           str(tmp_path / 'office.yaml')]) == 0
    assert not {'bottle', 'cup'} & {*LandmarkMap.from_file(tmp_path / 'office.yaml').class_ids}
    told = capsys.readouterr().out
    assert "no box is of class 'persn' (did you mean 'person'?)" in told and 'Bottle' not in told
