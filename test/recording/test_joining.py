# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several recordings of a place: where they lie, and what a map takes from them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.cli import build_map
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform, move_poses, rotation_angle_deg
from cliploc_ros.core.keyframes.features import SIFT, compact
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, TRIANGULATED, KeyframeLayer, Source
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.offline.datasets.map_recording import load_recording
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping.posed_detections import join_detections
from cliploc_ros.offline.recording.joining import add_layer, find_placing, recognize
from cliploc_ros.offline.recording.layer_words import with_words

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
LOOK = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # along x, z up


def make_wall(seed):
    """Return 1500 points of a rough wall at x = 4 m, and their descriptors."""
    rng = np.random.default_rng(seed)
    units = np.abs(rng.normal(size=(1500, SIFT.dimensions))) ** 3
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    return rng.uniform([3.5, -6.0, -1.5], [4.5, 6.0, 1.5], (1500, 3)), compact(units)


def see(wall, places, turn_deg=0.0, name='monday', shift=(0.0, 0.0, 0.0)):
    """Return the layer of cameras at places y; shift: how far their poses are off."""
    parts, rng = [], np.random.default_rng(len(places))
    turn = Rotation.from_euler('z', turn_deg, degrees=True).as_matrix() @ LOOK
    for place in places:
        pose = make_transform(turn, np.array([0.0, place, 0.0]))
        inside = (wall[0] - pose[:3, 3]) @ pose[:3, :3]
        pixels = CAMERA.project_normalized(inside[:, :2] / inside[:, 2:])
        seen = (inside[:, 2] > 0.5) & (pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1)
        pixels = pixels[seen] + rng.normal(0, 0.5, (seen.sum(), 2))
        pose[:3, 3] += shift
        parts.append((pose, np.clip(pixels, 0, 639), inside[seen], wall[1][seen]))
    poses, pixels, points, descriptors = zip(*parts, strict=True)
    pixels = np.round(np.concatenate(pixels) * PIXEL_SCALE).astype(np.uint16)
    found = np.concatenate(descriptors)
    return with_words(KeyframeLayer(
        'map', (), np.empty((0, 3), np.float32), (CAMERA,), np.array(poses),
        np.cumsum([0, *map(len, points)]), pixels, np.concatenate(points).astype(np.float32),
        found, np.zeros(len(found), np.uint16), found[:1], TRIANGULATED,
        sources=(Source(name, '2026-11-29'),)))


@pytest.fixture(scope='module')
def wall():
    return make_wall(0)


@pytest.fixture(scope='module')
def mapped(wall):
    return see(wall, np.linspace(-3.0, 3.0, 13))


def elsewhere(layer, scale=1.0):
    """Return a layer in another coordinate frame and unit, and what moves it back."""
    turn, shift = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), np.array([7.0, -2.0, 1.0])
    poses = move_poses(layer.map_from_camera, 1.0 / scale, turn.T, -turn.T @ shift / scale)
    return replace(layer, map_from_camera=poses, points=layer.points / np.float32(scale)), shift


@pytest.mark.parametrize('scale', [1.0, 2.5])
def test_another_coordinate_frame_and_unit_are_found(wall, mapped, scale):
    truth = see(wall, np.linspace(-2.5, 2.5, 9), 10.0, 'tuesday')
    moved, _ = elsewhere(truth, scale)
    joined, placing, note = add_layer(mapped, moved, scale != 1.0, False, 40)
    found = move_poses(moved.map_from_camera, *placing)
    assert np.linalg.norm((found - truth.map_from_camera)[:, :3, 3], axis=1).max() < 0.02
    assert rotation_angle_deg(found[0, :3, :3].T @ truth.map_from_camera[0, :3, :3]) < 0.5
    assert placing.scale == pytest.approx(scale, rel=0.01) and '9 keyframes place it' in note
    assert len(joined) == len(mapped)  # the map localizes all of them


def test_other_places_and_two_placings_are_refused(wall, mapped):
    other = see(make_wall(1), np.linspace(-2.5, 2.5, 9))
    with pytest.raises(MappingError, match='0 of 0 recognized keyframes agree'):
        add_layer(mapped, other, False, False, 40)
    halves = [see(wall, np.linspace(start, start + 2.0, 6), shift=shift)
              for start, shift in ((-3.0, (0.0, 0.0, 0.0)), (1.0, (0.0, 4.0, 0.0)))]
    sights = [sight for half in halves for sight in recognize(half, mapped)]
    with pytest.raises(MappingError, match='6 of 12 recognized keyframes agree about it, 6 about'):
        find_placing(sights)
    assert find_placing(sights[:8])[1] == 6


def test_poses_of_one_frame_stay_and_their_shift_is_named(wall, mapped):
    shifted = see(wall, np.linspace(-2.5, 2.5, 9), shift=(0.0, 0.3, 0.0))
    joined, placing, note = add_layer(mapped, shifted, False, True, 40)
    assert '0.30 m and 0.' in note and 'which stay' in note
    assert not placing.shift.any() and len(joined) == len(mapped)
    _, _, note = add_layer(mapped, see(make_wall(1), [0.0]), False, True, 40)
    assert note.startswith('it is not compared with the map')


def test_new_views_are_added_with_their_source_and_displaced_ones_are_not(wall, mapped):
    first = mapped.select(mapped.map_from_camera[:, 1, 3] < 0.1)
    new = see(wall, np.linspace(-1.0, 5.0, 13), name='tuesday')
    poses = new.map_from_camera.copy()
    poses[1, 1, 3] += 5.0
    joined, _, note = add_layer(first, replace(new, map_from_camera=poses), False, False, 40)
    own = joined.map_from_camera[joined.source_rows == 1]
    assert [source.name for source in joined.sources] == ['monday', 'tuesday']
    assert 0 < len(own) < 10 and own[:, 1, 3].min() > 1.0 and '1 contradict' in note
    assert joined.deviations().shape == (len(joined),)
    few, _, note = add_layer(first, new, False, False, 1)
    assert len(few) < len(joined) - 2 and 'full cells lose 0' not in note


@pytest.fixture
def halves(shared_data, tmp_path):
    whole = load_observations(shared_data / 'tum_fr3_office' / 'observations.npz')
    paths = []
    for name, frames in (('a', range(0, 1290, 16)), ('b', range(1290, 2580, 16))):
        save_observations(path := tmp_path / f'{name}.npz', whole.select_frames(frames))
        paths.append(path)
    return paths


def test_detections_are_joined_by_the_names_of_classes_and_cameras(halves):
    one, two = map(load_observations, halves)
    one = replace(one, depths=np.ones(len(one.classes), np.float32))
    small = replace(CAMERA, fx=400.0)
    joined = join_detections([one, replace(two, cameras=(small,))])
    assert len(joined) == len(one) + len(two) and joined.cameras == (*one.cameras, small)
    assert joined.camera_names == ('', '#1') and (np.diff(joined.stamps_s) > 0.0).all()
    last = len(joined) - 1
    assert joined.detections_of(last).class_ids == two.detections_of(len(two) - 1).class_ids
    assert np.isnan(joined.depths).sum() == len(two.classes)
    with pytest.raises(DatasetError, match='different encoders'):
        join_detections([one, replace(two, encoder_key='clip:1')])


def test_observations_are_joined_and_added(run_here, halves, tmp_path):
    a, b = halves
    both, out = tmp_path / 'both.yaml', tmp_path / 'map.yaml'
    options = ['--observations', a, '--observations', b, '--no-check']
    done = run_here(build_map.main, *options, '--out', both)
    assert done.returncode == 1 and 'b.npz: no keyframes place it' in done.stderr
    done = run_here(build_map.main, *options, '--same-frame', '--out', both)
    assert done.returncode == 0 and ' 162 frames' in done.stdout, done.stderr
    for more in (['--observations', a], ['--add', out, '--observations', b, '--same-frame']):
        done = run_here(build_map.main, *more, '--no-check', '--out', out, '--frame-id', 'office')
        assert done.returncode == 0, done.stderr
    assert LandmarkMap.from_file(out).frame_id == 'office'
    assert LandmarkMap.from_file(out).landmark_ids == LandmarkMap.from_file(both).landmark_ids
    assert len(load_recording(out).load()) == 162
    for wrong, named in ((['--update', out], 'in turn'), (['--refine-mount'], 'one recording')):
        done = run_here(build_map.main, *options, *wrong, '--out', out)
        assert done.returncode == 1 and named in done.stderr
    done = run_here(build_map.main, '--out', out)
    assert done.returncode == 1 and 'give a recording' in done.stderr
