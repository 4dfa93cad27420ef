# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings without landmarks, with poor landmarks or moving objects get clear messages."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.cli import build_map, check_map
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping.building import build_map as build
from cliploc_ros.offline.mapping.check.checking import check_map as check
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions


def test_a_map_of_keyframes_alone(shared_data, tmp_path, capsys):
    """There is no landmark, but the images still localize the camera."""
    folder, out = shared_data / 'tum_fr3_office', tmp_path / 'office.yaml'
    given = ['--tum', str(folder), '--no-clip', '--min-viewpoints', '16', '--out', str(out),
             '--model', str(shared_data / 'weights/yolov8n_coco.pt'),
             '--record-to', str(tmp_path / 'seen.npz')]
    assert build_map.main(given) == 0
    assert 'keyframes only: no landmark' in capsys.readouterr().out
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
    assert check_map.main([str(out)]) == 1
    assert 'keyframes only' in capsys.readouterr().out
    assert build_map.main([*given, '--no-keyframe-layer']) == 1


@pytest.fixture(scope='module')
def office(shared_data):
    detections = load_observations(shared_data / 'tum_fr3_office/observations.npz')
    return detections.select_frames(range(0, len(detections), 20))


def test_a_poor_map_takes_no_place(office, tmp_path, capsys):
    """Poses of other images: the map is written under another name, and the exit code is 1."""
    rng = np.random.default_rng(0)
    poses = office.map_from_camera.copy()
    poses[:, :3, 3] += rng.normal(0.0, 1.2, (len(poses), 3))
    save_observations(tmp_path / 'off.npz', replace(office, map_from_camera=poses))
    out = tmp_path / 'office.yaml'
    out.write_text('the map before')
    code = build_map.main(['--observations', str(tmp_path / 'off.npz'), '--no-clip', '--no-joint',
                           '--no-check', '--out', str(out)])
    assert code == 1 and out.read_text() == 'the map before'
    assert 'refused: ' in capsys.readouterr().out
    assert len(LandmarkMap.from_file(tmp_path / 'office.refused.yaml')) > 0


def test_what_moves_is_no_landmark(office, tmp_path, capsys):
    """The bottles are persons here: none is mapped unless the list allows it."""
    names = tuple('person' if name == 'bottle' else name for name in office.class_names)
    crowded = replace(office, class_names=names)
    plain = build(crowded, MappingOptions(moving_classes=())).landmark_map
    assert 'person' in plain.class_ids
    built = build(crowded)
    assert 'person' not in built.landmark_map.class_ids
    assert any('person are not landmarks' in note for note in built.report.notes)
    report = check(plain, crowded, CheckOptions(
        folds=2, frames=1, max_positions=1, headings=1))
    faults = {landmark.landmark_id: landmark for landmark in report.landmarks}
    assert all(faults[name].severity >= 1.0 for name, kind in zip(
        plain.landmark_ids, plain.class_ids, strict=True) if kind == 'person')
    save_observations(tmp_path / 'office.npz', office)
    assert build_map.main(['--observations', str(tmp_path / 'office.npz'), '--no-clip',
                           '--no-check', '--moving', 'Bottle, cup, persn', '--out',
                           str(tmp_path / 'office.yaml')]) == 0
    assert not {'bottle', 'cup'} & {*LandmarkMap.from_file(tmp_path / 'office.yaml').class_ids}
    told = capsys.readouterr().out
    assert "no box is of class 'persn' (did you mean 'person'?)" in told and 'Bottle' not in told
