# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps, their embeddings and several maps in one: reading, writing and refusing."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scene import BY_CLASS, CAMERA, MAP_FROM_CAMERA, ROOM, see_room, unit_rows

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.joined_map import MAX_MAPS, join_maps, parts_of, place_of
from cliploc_ros.core.map.landmark_details import LandmarkDetails, join_details
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
    load_landmark_embeddings,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer, in_its_map
from cliploc_ros.errors import CliplocError, MapError

CUP = {'class_id': 'cup', 'center': [1.0, 2.0, 3.0], 'semi_axes': [0.1, 0.2, 0.3],
       'orientation': [0.0, 0.0, 0.0, 1.0]}
FULL = LandmarkDetails(
    labels=(('a "red" cup: with #', 0.75), ('a mug', 0.25)),
    class_weights=(('cup', 0.9), ('wine glass', 0.1)), position_sigma=0.0125,
    shared_sigma=0.0175, shared_sigma_deg=0.375, support=37,
    seen_ratio=0.625, baseline_deg=71.5, last_seen=1341847980.75, source='build_map: office.npz')


def read(fields):
    return LandmarkMap.from_mapping({'frame_id': 'map', 'landmarks': {'cup_1': fields}}, 'here')


def test_a_written_map_is_read_back(tmp_path):
    odd = ('yes: "quoted" \\ #1: [\U0001f600]', 'tab\tand\nline', '\x7f', '\\ud83d', 'a\u2028"\\')
    room = replace(ROOM, labels=(*odd, *ROOM.labels[len(odd):]),
                   details=(FULL,) + (LandmarkDetails(support=3),) * (len(ROOM) - 1),
                   nav2_map='grid.yaml')
    write_map(tmp_path / 'map.yaml', room, ['two\nlines become one'])
    loaded = LandmarkMap.from_file(tmp_path / 'map.yaml')
    assert loaded.select([0]).with_more(loaded).nav2_map == 'grid.yaml', 'updates keep it'
    assert (loaded.frame_id, loaded.landmark_ids, loaded.labels, loaded.class_ids,
            loaded.details) == (room.frame_id, room.landmark_ids, room.labels, room.class_ids,
                                room.details)
    assert loaded.centers == pytest.approx(room.centers, abs=1e-5)
    assert loaded.semi_axes == pytest.approx(room.semi_axes, abs=1e-5)
    assert loaded.quats_xyzw == pytest.approx(room.quats_xyzw, abs=2e-5)


def test_image_embeddings_belong_to_one_map(tmp_path):
    path, room = tmp_path / 'map.yaml', ROOM
    rows = np.eye(12, 16, dtype=np.float16)
    seen = LandmarkEmbeddings('key', room.landmark_ids, rows, rows, np.arange(13))
    write_map(path, room, embeddings=seen)
    assert load_embeddings_of_map(path, room.landmark_ids).is_known.all()
    write_map(path, room)
    assert load_embeddings_of_map(path, room.landmark_ids) is None
    embeddings_path(path).mkdir()
    with pytest.raises(CliplocError, match='cannot be removed'):
        write_map(path, room)


def test_labels_may_stand_in_place_of_a_label():
    labels = {'text': ['a mug', 'a red cup'], 'weight': [0.25, 0.75]}
    landmark_map = read(CUP | {'labels': labels})
    assert landmark_map.labels == ('a red cup',)
    assert landmark_map.details[0].labels == (('a mug', 0.25), ('a red cup', 0.75))
    rows = [{'text': 'a mug', 'weight': 0.25}, {'text': 'a red cup', 'weight': 0.75}]
    assert read(CUP | {'labels': rows}).details == landmark_map.details
    assert read(CUP | {'labels': rows, 'label': 'mine'}).weighted_labels == (
        (('mine', 0.75), ('a mug', 0.25), ('a red cup', 0.75)),)


def test_a_thing_that_was_two_landmarks_has_the_labels_of_both_by_their_frames():
    often, once = (LandmarkDetails(support=count) for count in (3, 1))
    joined = join_details([('a mug', 'cup', often), ('a bowl', 'cup', once)])
    assert joined.labels == (('a mug', 0.75), ('a bowl', 0.25))


WITH_LABEL = CUP | {'label': 'a red cup'}


def file_of(landmarks, frame_id='map'):
    return {'/**': {'ros__parameters': {'map': {'frame_id': frame_id, 'landmarks': landmarks}}}}


def write(tmp_path, content):
    path = tmp_path / 'map.yaml'
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_a_nearly_unit_quaternion_is_normalized(tmp_path):
    tilted = WITH_LABEL | {'orientation': [0.0, 0.0, 0.7071, 0.7071]}
    others = {'/x': {'ros__parameters': {'k': 3}}, 'y': 1}
    loaded = LandmarkMap.from_file(write(tmp_path, others | file_of({'cup_1': tilted})))
    assert loaded.centers.tolist() == [[1.0, 2.0, 3.0]]
    assert loaded.semi_axes.tolist() == [[0.1, 0.2, 0.3]]
    assert np.linalg.norm(loaded.quats_xyzw) == pytest.approx(1.0, abs=1e-12)
    assert loaded.shapes[0] == pytest.approx([0.04, 0, 0, 0.01, 0, 0.09])


@pytest.mark.parametrize(('change', 'message'), [
    ({'center': [float('nan'), 0.0, 0.0]}, 'center: .*finite'),
    ({'center': [1e300, 0.0, 0.0]}, 'center: .*beyond'),
    ({'center': [True, 0.0, 0.0]}, 'center: .*3'), ({'semi_axes': [0.1, -1.0, 0.1]}, 'semi_axes'),
    ({'orientation': [0.0] * 4}, 'orientation: .*0'), ({'class_id': None}, 'class_id'),
    ({'colour': 'red'}, '.*colour'),
    ({'labels': {'text': ['a'], 'weight': [1.0, 2.0]}}, 'labels: .*equal length'),
    ({'labels': [{'text': 'a', 'weight': 0.0}]}, 'labels: .*above 0'),
    ({'class_weights': ['cup']}, 'class_weights'), ({'seen_ratio': -0.5}, 'seen_ratio: -0.5'),
    ({'seen_ratio': 10**400}, 'seen_ratio: 10'), ({'class_id': 1001 * 'x'}, 'class_id: longer')])
def test_bad_fields_are_named_with_file_and_landmark(change, message):
    with pytest.raises(MapError, match=f"here: landmark 'cup_1': {message}"):
        read(WITH_LABEL | change)


@pytest.mark.parametrize(('content', 'message'), [
    ('', 'not a YAML mapping'), ('a: [1, 2', 'line 1, column 4'),
    ('a: &x [1]\nb: *x\n', 'an alias'), ('a: 1\na: 2\n', "'a' is repeated"),
    ('[' * 1_000_000, 'nest'),
    (b'\x7fELF\xff\xfe\x00', 'not a text file'),
    (file_of(None), 'the map is empty'), (file_of({'a.b': WITH_LABEL}), 'without dots'),
    (file_of({'a': {'centre': 0, **WITH_LABEL}}), "mean 'center'"),
    (file_of({'a': WITH_LABEL}) | {'/x': {'ros__parameters': {'map': {}}}}, 'more than one map'),
    ('!!python/object/apply:os.system [echo]', 'not a YAML mapping')])
def test_broken_and_hostile_files_are_refused(tmp_path, content, message):
    with pytest.raises(MapError, match=message):
        LandmarkMap.from_file(write(tmp_path, content))


@pytest.mark.parametrize('name', ['a\0b', '\ud800', 'x' * 5000])
def test_names_that_no_file_can_have(name):
    with pytest.raises(MapError, match=r'not a valid path|too long'):
        LandmarkMap.from_file(name)


def looks(count, seed):
    return unit_rows(np.random.default_rng(seed).normal(size=(count, 8))).astype(np.float16)


@pytest.fixture
def embeddings():
    """Return three landmarks: with two medoids, with none and unknown, and with one."""
    means = looks(3, 0)
    means[1] = 0.0
    return LandmarkEmbeddings('tiny:gelu:1234', ('mug_1', 'mug_2', 'book_1'), means,
                              looks(3, 1), np.array([0, 2, 2, 3]))


def test_rows_take_the_order_of_a_map(embeddings):
    ordered = embeddings.in_order(['book_1', 'new', 'mug_1'])
    assert ordered.landmark_ids == ('book_1', 'new', 'mug_1')
    assert ordered.is_known.tolist() == [True, False, True]
    np.testing.assert_array_equal(ordered.means[[0, 2]], embeddings.means[[2, 0]])
    assert ordered.medoid_offsets.tolist() == [0, 1, 1, 3]
    np.testing.assert_array_equal(ordered.medoids, embeddings.medoids[[2, 0, 1]])
    assert embeddings.in_order([]).medoid_offsets.tolist() == [0]


def test_a_map_finds_the_file_next_to_it(tmp_path, embeddings):
    map_path = tmp_path / 'office.yaml'
    assert load_embeddings_of_map(map_path, ['mug_1']) is None
    save_landmark_embeddings(embeddings_path(map_path), embeddings)
    found = load_embeddings_of_map(map_path, embeddings.landmark_ids)
    np.testing.assert_equal(vars(found), vars(embeddings))
    assert found.is_known.tolist() == [True, False, True]
    found = load_embeddings_of_map(map_path, ['added', 'mug_1'])
    assert found.is_known.tolist() == [False, True]
    with pytest.raises(MapError, match='another map'):
        load_embeddings_of_map(map_path, ['chair_1'])


@pytest.mark.parametrize(('name', 'value', 'message'), [
    ('means', looks(2, 0), r'means has shape \(2, 8\)'),
    ('landmark_ids', np.array(['a', 'b', 'a']), 'repeats an id'),
    ('means', np.full((3, 8), np.nan), 'unit length in row 0'),
    ('medoid_offsets', np.array([0, 1, 2, 2]), 'medoid_offsets ranges from 0 to 2'),
    ('medoid_offsets', np.array([0, 3, 2, 3]), 'medoid_offsets decreases')])
def test_a_malformed_array_is_refused(tmp_path, embeddings, name, value, message):
    path = tmp_path / 'wrong.npz'
    np.savez(path, **{key: np.array(array) for key, array in vars(embeddings).items()} | {
        name: value})
    with pytest.raises(MapError, match=message):
        load_landmark_embeddings(path)


def floor(name, seed=0):
    """Return a map with this name of twelve objects near the camera, placed by seed."""
    rng = np.random.default_rng(seed)
    return replace(ROOM, frame_id=name, centers=np.c_[
        rng.uniform(-1.2, 1.2, (12, 2)), rng.uniform(1.5, 4, 12)])


def join(*maps):
    return join_maps(maps, [f'{landmark_map.frame_id}.yaml' for landmark_map in maps])


def localize(landmark_map, seen, options=BY_CLASS, similarities=None):
    found = Relocalizer(landmark_map, options).relocalize(
        [Observation(CAMERA, see_room(seen), similarities)])
    return in_its_map(found, landmark_map)


@pytest.mark.parametrize('place', [0, 1, 7])
def test_the_right_one_of_different_floors_is_accepted(place):
    """The pose is the same as in a search of this map alone, and in its coordinate frame."""
    maps = [floor(f'floor_{number}', seed=number) for number in range(8)]
    found, part = localize(join(*maps), maps[place])
    alone, _ = localize(maps[place], maps[place])
    assert found.accepted and part.landmark_map is maps[place]
    assert max(pose_error(found.map_from_camera, MAP_FROM_CAMERA)) < 1.0
    assert np.allclose(found.map_from_camera, alone.map_from_camera, atol=1e-6)
    assert np.diag(found.covariance) == pytest.approx(np.diag(alone.covariance), rel=0.02)
    assert {match.landmark for match in found.matches} == set(range(12))


@pytest.mark.parametrize('turned', [False, True])
def test_equal_floors_are_refused_and_both_are_named(turned):
    maps = [floor('floor_1'), floor('floor_2')]
    found, part = localize(join(*(maps[::-1] if turned else maps)), maps[0])
    assert not found.accepted
    assert found.reason.startswith(f'in {part.landmark_map.frame_id}: confidence 0.')
    assert 'floor_1' in found.reason and 'floor_2' in found.reason


def test_the_twin_of_a_place_is_given_in_its_own_map():
    """One of two equal maps lacks an object: the pose in the other map leads, but has a twin."""
    whole = floor('floor_1')
    lacking = replace(whole.select(range(11)), frame_id='floor_2',
                      centers=whole.centers[:11] + np.array([500.0, -3.0, 0.0]))
    found, _ = localize(join(lacking, whole), whole)
    assert not found.accepted
    assert 'in floor_1: ' in found.reason and 'floor_2' in found.reason
    assert '(500.' in found.reason


def test_many_floors_get_equal_shares_of_the_candidates():
    """Twenty equal floors give at least one hypothesis each: none is left out."""
    maps = [floor(f'floor_{number}') for number in range(20)]
    rows = np.full((12, 12), 0.2) + 0.2 * np.eye(12)
    found, _ = localize(join(*maps), maps[0], RelocalizerOptions(), np.tile(rows, 20))
    assert not found.accepted and found.reason.count('in floor_') == 2, found.reason
    assert found.confidence < 0.3


def test_a_search_too_short_for_all_maps_is_refused():
    """The least number of samples applies to each map: each of them gets enough."""
    maps = [floor(f'floor_{number}', seed=number) for number in range(10)]
    rows = np.full((12, 12), 0.2) + 0.2 * np.eye(12)
    short = RelocalizerOptions(iterations=600)
    found, _ = localize(maps[0], maps[0], short, rows)
    assert found.accepted
    found, _ = localize(join(*maps), maps[0], short, np.tile(rows, 10))
    assert not found.accepted and 'in floor_0: search' in found.reason


def test_a_joined_map_keeps_what_its_maps_hold():
    plain, detailed = floor('hall'), floor('attic', seed=3)
    detailed = replace(detailed, details=tuple(
        LandmarkDetails(class_weights=(('z', 1.0), (name, 1.0))) for name in detailed.class_ids))
    both = join(plain, detailed)
    assert len(both) == 24 and both.frame_id == 'hall'
    assert both.landmark_ids[:1] == ('hall/thing_0',) and len(set(both.landmark_ids)) == 24
    assert np.array_equal(both.centers[:12], plain.centers)
    assert both.classes.sizes_of(both.classes.classes_of(['z'])).tolist() == [12]
    assert [part.first for part in parts_of(both)] == [0, 12]
    apart = both.centers[12:, 0].min() - both.centers[:12, 0].max()
    assert apart >= 100_000 * both.semi_axes.max()
    for part in parts_of(both):
        pose = MAP_FROM_CAMERA.copy()
        pose[:3, 3] += part.shift
        place = place_of(both, pose)
        assert place.part is part and place.name == part.landmark_map.frame_id
        assert np.allclose(place.map_from_camera, MAP_FROM_CAMERA, atol=1e-6)


def test_maps_that_cannot_be_told_apart_are_refused():
    with pytest.raises(MapError, match="frame_id 'map'"):
        join(floor('map'), floor('hall'), floor('map', seed=1))
    with pytest.raises(MapError, match=f'at most {MAX_MAPS}'):
        join(*[floor(f'floor_{number}') for number in range(MAX_MAPS + 1)])
