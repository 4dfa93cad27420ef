# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: the layer's file, and poses and points from matched features."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, ROOM, level, make_layer, rigid
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.keyframes import localization
from cliploc_ros.core.keyframes.features import DIMENSIONS, SIFT, Features, extract
from cliploc_ros.core.keyframes.layer import Source, layer_path, load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.keyframes.point_pose import find_pose, free_focal, refine
from cliploc_ros.core.search.scene import Constraint
from cliploc_ros.errors import MapError
from cliploc_ros.offline.recording import layer_words
from cliploc_ros.offline.recording.keyframe_layer import PosedFeatures, triangulate

KEYFRAMES, POINTS = 6, 40


@pytest.fixture
def file(tmp_path):
    path = layer_path(tmp_path / 'room.yaml')
    save_layer(path, make_layer(ROOM))
    return path


def rewrite(path, header=None, **changes):
    """Write the file again with other arrays or header; None removes an array."""
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files} | changes
    if header:
        arrays['header'] = np.array(json.dumps(json.loads(str(arrays['header'])) | header))
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def test_a_layer_comes_back_as_it_was(file):
    assert file.name == 'room.keyframes.npz'
    before, after = make_layer(ROOM), load_layer_of_map(file, ROOM)
    assert after.cameras == before.cameras and after.landmark_ids == before.landmark_ids
    for name in ('map_from_camera', 'offsets', 'pixels', 'points', 'descriptors', 'words',
                 'vocabulary'):
        assert np.array_equal(getattr(after, name), getattr(before, name)), name


def test_deviations_and_recordings_of_keyframes_come_back(tmp_path):
    deviations, sources = np.linspace(0.0, 0.1, KEYFRAMES), (Source('monday', '2026-11-23'),
                                                             Source('friday'))
    save_layer(tmp_path / 'room.npz', replace(
        make_layer(ROOM), deviation_per_metre=deviations, sources=sources,
        source_rows=np.array([0, 0, 0, 1, 1, 1])))
    after = load_layer_of_map(tmp_path / 'room.npz', ROOM)
    np.testing.assert_array_equal(after.deviations(), deviations)
    assert after.sources == sources and after.source_rows.tolist() == [0, 0, 0, 1, 1, 1]


def test_a_layer_of_version_1_has_one_deviation_and_no_recordings(file):
    rewrite(file, {'version': 1, 'deviation_per_metre': 0.02, 'sources': []},
            deviation_per_metre=None)
    layer = load_layer_of_map(file, ROOM)
    assert layer.deviations().tolist() == [0.02] * KEYFRAMES
    assert layer.sources == () and layer.source_rows is None
    rewrite(file, {'deviation_per_metre': 1.5})
    with pytest.raises(MapError, match='deviation_per_metre is not 0 to 1'):
        load_layer_of_map(file, ROOM)


def test_mapped_arrays_survive_a_replaced_file_and_a_flipped_bit_is_found(file, monkeypatch):
    monkeypatch.setattr('cliploc_ros.files.arrays._MAPPED_BYTES', 0)
    before, layer = make_layer(ROOM), load_layer_of_map(file, ROOM)
    assert not layer.descriptors.flags.owndata
    save_layer(file, replace(before, descriptors=before.descriptors[::-1]))
    for name in ('pixels', 'points', 'descriptors'):
        np.testing.assert_array_equal(getattr(layer, name), getattr(before, name))
    content = bytearray(file.read_bytes())
    content[content.index(before.descriptors[-1].tobytes()) + 5] ^= 1
    file.write_bytes(content)
    with pytest.raises(MapError, match='descriptors cannot be read: Bad CRC'):
        load_layer_of_map(file, ROOM)


def test_an_edited_map_keeps_its_layer(file):
    fewer = ROOM.select(range(1, len(ROOM)))
    moved = replace(fewer, centers=fewer.centers + np.eye(len(fewer))[:, :1] * 3.0)
    assert len(load_layer_of_map(file, moved)) == KEYFRAMES


@pytest.fixture
def corridor():
    """Return twenty keyframes 10 m apart, each with forty points in the middle of the image."""
    layer = make_layer(ROOM, keyframes=20)
    poses = layer.map_from_camera.copy()
    poses[:, 0, 3] = 10.0 * np.arange(len(layer))
    return replace(layer, map_from_camera=poses, points=np.random.default_rng(1).uniform(
        (-0.4, -0.4, 1.0), (0.4, 0.4, 1.5), layer.points.shape).astype(np.float32))


def features_of(pixels, descriptors=None):
    if descriptors is None:
        descriptors = np.zeros((len(pixels), DIMENSIONS), np.uint8)
    return Features(pixels, descriptors, np.ones(len(pixels), np.float32))


def features_at(layer, keyframe, shown=slice(None)):
    """Return features of some points of a keyframe, from a camera 0.1 m to the right."""
    rows = np.arange(*layer.offsets[keyframe:keyframe + 2])[shown]
    points = layer.points[rows] - np.array([0.1, 0.0, 0.0])
    return features_of(CAMERA.project_normalized(points[:, :2] / points[:, 2:]),
                       layer.descriptors[rows])


@pytest.mark.parametrize('misleading', [0, 15])
def test_a_keyframe_is_found_though_others_look_more_like_the_image(corridor, misleading, rng):
    """These keyframes have most words of the image, but their points agree on no pose."""
    own = features_at(corridor, 18, slice(30))
    descriptors = np.concatenate([own.descriptors, *(
        features_at(corridor, keyframe).descriptors for keyframe in range(misleading))])
    others = rng.uniform(0.0, (CAMERA.width, CAMERA.height), (len(descriptors) - len(own), 2))
    seen = features_of(np.concatenate([own.pixels, others]), descriptors)
    localizer = KeyframeLocalizer(corridor)
    fast = localizer.localize_features(seen, CAMERA)
    too_low = localizer.localize_features(seen, CAMERA, constraint=Constraint(min_height=1.0))
    assert (too_low.places, too_low.outside_m) == ((), pytest.approx(0.0, abs=1e-3))
    # the thorough pass finds it too, although its pooled matches are less clear
    for place, in (fast.places, localizer.localize_features(seen, CAMERA, fast=fast).places):
        assert place.map_from_camera[:3, 3] == pytest.approx([180.1, 0.0, 0.0], abs=1e-3)
        assert (place.inliers, place.keyframes) == (30, (18,))
        assert place.apart == pytest.approx(0.1 / 2.0, abs=1e-3)
        turned = rigid(place.map_from_camera[:3, 3], 'y', 45.0)
        assert 18 not in localization.keyframes_near(corridor.map_from_camera, turned)
        assert abs(place.focal_ratio - 1.0) <= 3.0 * place.focal_deviation < 0.1


@pytest.mark.parametrize('fast', [None, Recognition()])
@pytest.mark.parametrize('has_empty', [False, True])
def test_one_keyframe_and_one_without_points_are_searched(corridor, has_empty, fast):
    layer, pose = corridor.select(np.arange(20) == 18), corridor.map_from_camera[18]
    np.testing.assert_array_equal(layer.words, corridor.words[18 * POINTS:19 * POINTS])
    if has_empty:  # another keyframe with the same view, but without points
        layer = replace(layer, map_from_camera=np.array([pose, pose]), offsets=np.array(
            [0, 0, POINTS]))
    place, = KeyframeLocalizer(layer).localize_features(features_at(corridor, 18), CAMERA,
                                                        fast=fast).places
    assert place.inliers == POINTS
    assert place.map_from_camera[:3, 3] == pytest.approx([180.1, 0.0, 0.0], abs=1e-3)


def test_a_view_finds_what_a_copy_finds(corridor):
    chosen = np.arange(20) % 3 == 0
    view, copy = corridor.view(chosen), corridor.select(chosen)
    assert view.points is corridor.points
    seen = features_at(corridor, 18)
    units = SIFT.units(seen.descriptors)
    np.testing.assert_array_equal(view.similarities(units), copy.similarities(units))
    place, same = (KeyframeLocalizer(layer).localize_features(seen, CAMERA).places[0]
                   for layer in (view, copy))
    np.testing.assert_array_equal(place.map_from_camera, same.map_from_camera)
    np.testing.assert_array_equal(view.view(np.arange(7) == 6).plain().points,
                                  corridor.points[18 * POINTS:19 * POINTS])


def test_points_are_left_out(corridor):
    kept = np.arange(20 * POINTS) % POINTS < 30
    layer = corridor.select(np.arange(20) > 9, kept)
    assert np.diff(layer.offsets).tolist() == [30] * 10
    np.testing.assert_array_equal(layer.descriptors[:30], corridor.descriptors[
        10 * POINTS:10 * POINTS + 30])


def test_a_large_layer_is_compressed_and_finds_the_same_places(corridor, monkeypatch, file):
    """It has two levels of words, and codes; a layer that is joined or changed is plain again."""
    random = np.random.default_rng(3)
    near = np.clip(random.integers(0, 120, (30, DIMENSIONS))[random.integers(0, 30, 20 * POINTS)]
                   + random.normal(0.0, 12.0, corridor.descriptors.shape), 0, 255)
    corridor = replace(corridor, descriptors=near.astype(np.uint8))
    for name, value in (('_LARGE', 1), ('_TWO_LEVELS', 1), ('_IN_GROUP', 3), ('WORDS', 32)):
        monkeypatch.setattr(layer_words, name, value)
    monkeypatch.setattr('cliploc_ros.core.keyframes.layer.WORDS', 32)
    save_layer(file, layer_words.with_words(corridor))
    layer = load_layer_of_map(file, ROOM)
    assert layer.descriptors.shape[1] == 16 and layer.vocabulary.shape == (96, DIMENSIONS)
    cosines = np.sum(SIFT.units(layer.plain().descriptors) * SIFT.units(corridor.descriptors), 1)
    assert np.median(cosines) > 0.97
    for keyframe in (0, 7, 18):
        seen = features_at(corridor, keyframe)
        assert np.argmax(layer.similarities(SIFT.units(seen.descriptors))) == keyframe
        place, = KeyframeLocalizer(layer).localize_features(seen, CAMERA).places
        assert place.map_from_camera[0, 3] == pytest.approx(10.0 * keyframe + 0.1, abs=0.01)
    again = layer_words.with_words(layer.plain())
    assert again.codebook is not None and again.points.dtype == np.float16
    np.testing.assert_array_equal(layer_words.with_words(corridor).descriptors,
                                  layer.descriptors, 'equal layers have equal codes')


def test_a_place_tells_the_distance_of_its_nearest_keyframe(corridor):
    one = corridor.select(np.arange(20) == 18)
    doubled = {name: np.concatenate([getattr(one, name)] * 2)
               for name in ('map_from_camera', 'pixels', 'points', 'descriptors', 'words')}
    doubled['map_from_camera'][1, 0, 3] -= 1.0
    doubled['points'][POINTS:, 0] += 1.0
    layer = replace(one, offsets=np.array([0, POINTS, 2 * POINTS]), **doubled)
    place, = KeyframeLocalizer(layer).localize_features(features_at(one, 0), CAMERA).places
    assert set(place.keyframes) == {0, 1} and place.apart == pytest.approx(0.1 / 2.0, abs=1e-3)


@pytest.mark.parametrize(('moved_m', 'moved', 'beside', 'parted'), [
    (0.6, 15, 0, 15 / 40), (0.6, 15, 15, 0.0), (0.1, 15, 0, 0.0),
    (0.6, 5, 0, 0.0), (0.0, 15, 0, 0.0)])
def test_a_place_of_which_a_part_was_elsewhere_is_parted(corridor, moved_m, moved, beside, parted):
    """Neither few points, nor errors of the map, nor a repeating texture are a changed place."""
    layer = corridor.select(np.arange(20) == 18)
    layer.points[-beside or POINTS:] = 1.01 * layer.points[:beside]
    seen = features_at(layer, 0)
    layer.points[-moved:, 0] += moved_m
    place = KeyframeLocalizer(layer).localize_features(seen, CAMERA).places[0]
    assert place.parted == pytest.approx(parted, abs=0.06)


def test_a_pose_is_refined_by_points_that_matching_missed(corridor):
    """Each point of the second half looks like its neighbour, so none of its matches is clear."""
    layer = corridor.select(np.arange(20) == 18)
    alike = np.arange(POINTS // 2, POINTS - 1, 2)
    layer.descriptors[alike + 1] = layer.descriptors[alike]
    fast, thorough = (KeyframeLocalizer(layer).localize_features(
        features_at(layer, 0), CAMERA, fast=one).places[0] for one in (None, Recognition()))
    assert thorough.inliers == fast.inliers <= POINTS - 2 * len(alike), 'no further evidence'
    assert len(thorough.pixels) == POINTS
    np.testing.assert_allclose(thorough.map_from_camera, fast.map_from_camera, atol=1e-3)


@pytest.mark.parametrize('focal', [1.0, 1e5, 1e-3])
def test_a_thorough_search_ends_with_any_focal_length(corridor, focal):
    """With a long lens, all features are at the position of each point in the image."""
    own = features_at(corridor, 18)
    seen = features_of(*(np.tile(rows, (3000 // len(own), 1))
                         for rows in (own.pixels, own.descriptors)))
    camera = replace(CAMERA, fx=CAMERA.fx * focal, fy=CAMERA.fy * focal)
    localizer = KeyframeLocalizer(corridor)
    fast = localizer.localize_features(seen, camera)
    found = localizer.localize_features(seen, camera, fast=fast)
    assert found.is_thorough and found.is_complete
    assert bool(found.places) or focal != 1.0


def test_a_keyframe_near_a_guess_is_found_though_many_look_more_like_the_image(corridor):
    own = features_at(corridor, 18, slice(15))
    others = [features_at(corridor, keyframe, slice(20)) for keyframe in range(15)]
    seen = features_of(np.concatenate([own.pixels, *(one.pixels[::-1] for one in others)]),
                       np.concatenate([one.descriptors for one in (own, *others)]))
    localizer, guess = KeyframeLocalizer(corridor), corridor.map_from_camera[18]
    assert localizer.localize_features(seen, CAMERA).places == ()
    place, = localizer.localize_features(seen, CAMERA, (guess,)).places
    assert place.keyframes == (18,)


def test_the_covariance_of_a_place_has_the_errors_of_points_and_of_keyframes(corridor, rng):
    own = features_at(corridor, 18)
    seen = replace(own, pixels=own.pixels + rng.normal(0.0, 1.0, own.pixels.shape))
    place, = KeyframeLocalizer(corridor).localize_features(seen, CAMERA).places
    of_points = refine(place.points, CAMERA.normalize_points(place.pixels),
                       invert_transform(place.map_from_camera)).covariance
    # several keyframes show the same points, and nearby points share errors
    np.testing.assert_allclose(place.covariance - place.shared, 4.5 ** 2 * of_points, rtol=0.02)
    position, turn = place.shared[0, 0], place.shared[3, 3]
    assert position == pytest.approx(0.012 ** 2 + (0.1 * corridor.deviation_per_metre) ** 2,
                                     rel=0.3)
    assert turn == pytest.approx(np.radians(0.45) ** 2, rel=0.3)


@pytest.mark.parametrize('similar', [1, 5, 12])
def test_a_place_that_looks_alike_is_found_behind_many_keyframes_of_the_first(corridor, similar):
    """Only a keyframe at another place shows that the image has two answers."""
    rows = np.concatenate([np.arange(POINTS)] * similar + [np.arange(POINTS - 10)])
    poses = np.tile(np.eye(4), (similar + 1, 1, 1))
    poses[-1, 0, 3] = 50.0
    layer = replace(corridor, map_from_camera=poses, offsets=np.append(
        np.arange(0, POINTS * similar + 1, POINTS), len(rows)), **{
        name: getattr(corridor, name)[rows] for name in ('pixels', 'points', 'descriptors',
                                                         'words')})
    places = KeyframeLocalizer(layer).localize_features(features_at(corridor, 0), CAMERA).places
    assert [place.map_from_camera[0, 3] for place in places] == pytest.approx(
        [0.1, 50.1], abs=0.01)
    assert [place.inliers for place in places] == [POINTS, POINTS - 10]


def test_keyframes_know_what_is_inside_of_the_image(corridor):
    localizer, (middle, aside) = KeyframeLocalizer(corridor), corridor.map_from_camera[[2, 2]]
    aside[0, 3] -= 1.9
    assert localizer.coverage(middle, CAMERA) > 0.0
    assert localizer.coverage(aside, CAMERA) == 0.0


@pytest.mark.parametrize(('other', 'message'), [
    (replace(ROOM, frame_id='odom'), "'map', expected 'odom'"),
    (replace(ROOM, landmark_ids=tuple(f'x{row}' for row in range(len(ROOM)))), 'no landmark'),
    (replace(ROOM, centers=ROOM.centers + 5.0), '8.66 m away from')])
def test_the_layer_of_another_map_is_named(file, other, message):
    with pytest.raises(MapError, match=message) as caught:
        load_layer_of_map(file, other)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'header': {'version': 3}}, 'version 3'),
    ({'header': {'descriptors': []}}, r"kind '\[\]', expected rootsift"),
    ({'header': {'camera': 7}}, 'camera'), ({'points': None}, 'points'),
    ({'points': np.zeros((3, 3), np.float32)}, r'points has shape'),
    ({'camera_rows': np.ones(KEYFRAMES, np.int64)}, 'outside the 1 cameras'),
    ({'source_rows': np.ones(KEYFRAMES, np.int64)}, 'outside the 1 sources'),
    ({'codebook': np.zeros((DIMENSIONS, 256, 2), np.int16)}, 'of 128 dimensions'),
    ({'vocabulary': np.zeros((1025, DIMENSIONS), np.uint8)}, '1025 words'),
    ({'map_from_camera': np.full((KEYFRAMES, 4, 4), np.nan)}, 'in row 0'),
    ({'words': np.full(KEYFRAMES * POINTS, 60_000, np.uint16)}, 'words')])
def test_malformed_files_are_named(file, changes, message):
    rewrite(file, **changes)
    with pytest.raises(MapError, match=message):
        load_layer_of_map(file, ROOM)


def test_another_camera_is_noted():
    layer = make_layer(ROOM)
    assert layer.camera_note(CAMERA) == ''
    assert layer.camera_note(Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)) == ''
    other = Camera(640, 480, 700.0, 700.0, 320.0, 240.0)
    assert 'fx 700.0' in layer.camera_note(other)
    assert replace(layer, cameras=(CAMERA, other)).camera_note(other) == ''


LENS = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


def look(rng, count=200, noise_px=0.0, offset=(0.0, 0.0, 0.0)):
    """Return a pose, points 1 to 4 m in front of it, and their bearings."""
    turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    pose = make_transform(turn, rng.normal(size=3) + offset)
    depths = rng.uniform(1.0, 4.0, count)
    bearings = rng.uniform((-0.6, -0.45), (0.6, 0.45), (count, 2))
    inside = np.column_stack([bearings, np.ones(count)]) * depths[:, None]
    points = inside @ pose[:3, :3].T + pose[:3, 3]
    return pose, points, bearings + rng.normal(0.0, noise_px / LENS.fx, bearings.shape)


@pytest.mark.parametrize('far_m', [0.0, 1e5], ids=['near', 'far from the origin'])
def test_a_pose_is_exact_without_noise_and_despite_outliers(far_m):
    rng = np.random.default_rng(1)
    pose, points, bearings = look(rng, offset=(far_m, 0.0, 0.0))
    bearings[:100] = rng.permutation(bearings[:100])
    found = find_pose(points, bearings)
    error_m, error_deg = pose_error(found.map_from_camera, pose)
    assert error_m < 1e-4
    assert error_deg < 1e-3
    assert set(found.inliers) >= set(range(100, 200))


def test_covariances_of_noisy_features_are_honest():
    rng, squares = np.random.default_rng(2), []
    for _ in range(60):
        pose, points, bearings = look(rng, 60, noise_px=1.0)
        found = find_pose(points, bearings)
        squares.append(normalized_square(found.map_from_camera, found.covariance, pose))
    # six degrees of freedom; the deviation of this mean is .45
    assert 4.0 < np.mean(squares) < 8.0


@pytest.mark.parametrize(('x', 'y'), [
    *((ratio, ratio) for ratio in (0.5, 0.8, 0.95, 1.0, 1.05, 1.25, 2.0)), (0.7, 1.0)])
def test_points_tell_focal_length_and_aspect_also_where_few_agree_with_the_given_ones(x, y):
    rng = np.random.default_rng(12)
    _, points, bearings = look(rng, 400, noise_px=1.0)
    bearings[::4] = rng.permutation(bearings[::4])
    start = invert_transform(find_pose(points, bearings * (x, y)).map_from_camera)
    found, deviations = free_focal(points, bearings * (x, y), start)
    assert (abs(found - 0.5 * np.log((x * y, x / y))) < 3.0 * deviations).all()
    assert (deviations < 0.004).all()


def test_few_points_points_on_a_line_and_points_that_agree_on_nothing_give_no_pose():
    line = np.linspace((0.0, 0.0, 2.0), (1.0, 0.5, 2.3), 20)
    assert refine(line, line[:, :2] / line[:, 2:], np.eye(4)) is None
    rng = np.random.default_rng(3)
    _, points, bearings = look(rng, 30)
    assert find_pose(points[:5], bearings[:5]) is None
    found = find_pose(points, rng.permutation(bearings))
    assert found is None or len(found.inliers) < 12
    assert find_pose(np.ones((20, 3)), np.zeros((20, 2))) is None


def places_of(bearings, features, points, counts):
    """Return the places of matched features and points, counts of which are of each keyframe."""
    matched = localization._Matched(features, points, np.repeat(np.arange(len(counts)), counts),
                                    np.arange(len(points)), np.zeros(len(points), np.float32))
    look_at = localization._Look(features_of(bearings * LENS.fx + (LENS.cx, LENS.cy)), bearings,
                                 LENS)
    return localization._places(localization._place(matched, look_at), matched, look_at)[0]


def test_the_place_in_more_parts_of_the_image_leads_before_a_poster_with_more_points():
    rng = np.random.default_rng(8)
    room, points, bearings = look(rng, 60)
    poster, shown, inside = look(rng, 120, offset=(9.0, 0.0, 0.0))
    inside *= 0.3  # as seen from there, in the middle of the image
    rays = np.column_stack([inside, np.ones(120)]) * rng.uniform(1.0, 4.0, (120, 1))
    shown = rays @ poster[:3, :3].T + poster[:3, 3]
    seen = np.concatenate([bearings, inside])
    first, second = places_of(seen, np.arange(180), np.concatenate([points, shown]), [60, 120])
    assert pose_error(first.map_from_camera, room)[0] < 1e-3
    assert pose_error(second.map_from_camera, poster)[0] < 1e-3
    assert (first.agreed, second.agreed) == (60, 120)


def test_a_constraint_tells_how_far_the_vertical_is_off():
    def tilted(degrees):
        return level(5.0, 6.0) @ rigid(degrees=degrees)  # to the side
    constraint = Constraint(max_tilt=np.radians(30.0))
    covariance = np.diag([1.0, 1.0, 1.0, np.radians(4.0) ** 2, 1.0, 1.0])  # about the x axis
    assert constraint.tilt_error(tilted(20.0), covariance) == 0.0, 'unknown'
    known = constraint._replace(vertical_deviation=np.radians(3.0))
    assert known.tilt_error(tilted(20.0), covariance) == pytest.approx(4.0)
    assert known.tilt_error(tilted(0.0), covariance) == pytest.approx(0.0)


def test_rays_of_equal_features_meet_in_their_point():
    rng = np.random.default_rng(4)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (50, 3))
    descriptors = rng.integers(0, 255, (50, DIMENSIONS)).astype(np.uint8)
    images = []
    for x in (0.0, 0.3, 0.6):
        pose = make_transform(Rotation.from_rotvec([0.0, -0.1 * x, 0.0]).as_matrix(),
                              np.array([x, 0.0, 0.0]))
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        images.append(PosedFeatures(pose, inside[:, :2] / inside[:, 2:], descriptors))
    images[2].bearings[:5] += 0.1  # mismatched there, but not in the second image
    assert np.abs(triangulate(images[0], images[1:]) - points).max() < 1e-6


def test_features_are_found_in_any_image():
    rng = np.random.default_rng(6)
    texture = rng.integers(0, 255, (30, 40, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
    features = extract(texture, 300)
    assert 100 < len(features) <= 300
    assert (np.diff(features.strengths) <= 0).all()
    small = extract(texture[:400, :500], 300)
    pairs, _ = SIFT.match(SIFT.units(small.descriptors), SIFT.units(features.descriptors))
    shifts = features.pixels[pairs[:, 1]] - small.pixels[pairs[:, 0]]
    assert len(pairs) > 50
    assert np.mean(np.abs(shifts).max(axis=1) < 0.5) > 0.9
    for empty in (np.zeros((480, 640, 3), np.uint8), np.zeros((1, 1, 3), np.uint8),
                  np.full((1, 1, 3), 255, np.uint8), np.full((2, 3000, 3), 90, np.uint8)):
        assert extract(empty, 300).pixels.shape == (0, 2)
    for shape in ((1, 1), (2, 2000), (2000, 2)):
        features = extract(rng.integers(0, 255, (*shape, 3), dtype=np.uint8), 100, 400)
        assert len(features) <= 100
        assert ((features.pixels > -1.0) & (features.pixels < shape[::-1])).all()
