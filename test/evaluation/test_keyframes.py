# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of real images: the kitchen with depth, the office without."""

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.layer import load_layer_of_map, load_layers, save_layer
from cliploc_ros.core.keyframes.localization import (
    ImageFeatures,
    ImageRecognizer,
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer, in_its_map
from cliploc_ros.core.watch.watch import Watch
from cliploc_ros.errors import MapError
from cliploc_ros.offline.datasets.folders import read_folder, rgbd_frames
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from studies.keyframes.cases import IMAGE_CHANGES, World, twin

EVERY = LayerOptions(0.0, 0.0)
OPTIONS = RelocalizerOptions(matching='class')
NO_OBJECTS = Detections(np.empty((0, 4)), (), np.empty(0))
MAPPED, ASKED = range(0, 30, 3), range(1, 30, 6)


@pytest.fixture(scope='module')
def room(shared_data):
    """Return any map: these tests use only features."""
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office' / 'map.yaml')


@pytest.fixture(scope='module')
def kitchen(shared_data):
    return rgbd_frames(shared_data / 'seven_scenes_kitchen', FolderOptions())


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    return read_folder(folder, FolderOptions(layout='tum'))


@pytest.fixture(scope='module')
def queries(kitchen):
    return list(kitchen.select(ASKED).read())


@pytest.fixture(scope='module')
def layer(kitchen, room, tmp_path_factory):
    """Return ten images of the kitchen as a written and reloaded layer."""
    path = tmp_path_factory.mktemp('layer') / 'kitchen.keyframes.npz'
    save_layer(path, build_layer(kitchen.select(MAPPED), room, EVERY))
    assert path.stat().st_size < 90e3 * len(MAPPED) + 0.2e6  # keyframes and vocabulary
    return load_layer_of_map(path, room)


@pytest.fixture
def answer(room):
    """Request a pose for an image without detections."""
    def relocalize(localizer, image_rgb, camera, landmark_map=room):
        recognizer = ImageRecognizer(localizer, ImageFeatures(lambda: image_rgb, camera))
        return Relocalizer(landmark_map, OPTIONS).relocalize(
            [Observation(camera, NO_OBJECTS)], recognizer)
    return relocalize


def test_the_kitchen_is_found_to_centimetres_and_accepted(layer, queries, answer):
    localizer = KeyframeLocalizer(layer)
    for frame in queries:
        found = answer(localizer, frame.image_rgb, frame.camera)
        assert found.accepted, found.reason
        assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.1
        assert np.sqrt(np.trace(found.covariance[:3, :3])) < 0.1


def test_a_refused_image_is_searched_thoroughly(layer, kitchen, room):
    localizer, frame = KeyframeLocalizer(layer), next(kitchen.select([33]).read())
    query = Query((Observation(frame.camera, NO_OBJECTS, np.empty((0, len(room)))),),
                  (frame.image_rgb,), None)

    def ask(query, deadline=np.inf):
        by = Localizer(Relocalizer(room, OPTIONS), localizer)
        return by.answer(query, deadline=deadline), by.query
    fast, fast_query = ask(replace(query, is_thorough=False))
    assert (fast.accepted, fast.keyframe_search) == (False, 'fast')
    thorough, thorough_query = ask(query)
    assert (thorough.accepted, thorough.keyframe_search) == (True, 'thorough')
    assert thorough.recognized.inliers > 1.3 * fast.recognized.inliers
    error_m, _ = pose_error(thorough.map_from_camera, frame.map_from_camera)
    assert error_m < min(0.1, pose_error(fast.map_from_camera, frame.map_from_camera)[0])
    # a recorded query states how far the search went, so its answer is repeated
    for found, recorded in ((fast, fast_query), (thorough, thorough_query)):
        again, _ = ask(recorded)
        np.testing.assert_array_equal(again.map_from_camera, found.map_from_camera)
        assert again.confidence == found.confidence
    # a thorough search that time cuts short changes nothing
    reads, deadline = [], time.monotonic() + 3.0

    def late():
        reads.append(1)
        if len(reads) == 2:
            time.sleep(max(0.0, deadline - time.monotonic()))
        return frame.image_rgb
    recognizer = ImageRecognizer(localizer, ImageFeatures(late, frame.camera), deadline)
    cut = Relocalizer(room, OPTIONS).relocalize([Observation(frame.camera, NO_OBJECTS)],
                                                recognizer)
    assert len(reads) == 2 and cut.keyframe_search == 'fast'
    np.testing.assert_array_equal(cut.map_from_camera, fast.map_from_camera)


@pytest.mark.parametrize('name', ['dark and noisy', 'half covered'])
def test_changed_images_are_found(layer, queries, name, answer):
    localizer, frame = KeyframeLocalizer(layer), queries[0]
    image = IMAGE_CHANGES[name](frame.image_rgb, frame.image_rgb, np.random.default_rng(0))
    found = answer(localizer, np.clip(image, 0, 255).astype(np.uint8), frame.camera)
    assert found.map_from_camera is not None
    assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.25


def test_another_room_is_refused(layer, office, answer):
    localizer = KeyframeLocalizer(layer)
    for frame in office.select(range(0, 17, 4)).read():
        assert not answer(localizer, frame.image_rgb, frame.camera).accepted


def test_the_watch_hears_keyframes(layer, queries, room):
    """In images without objects, only keyframes give poses."""
    localizer = KeyframeLocalizer(layer)
    for shift, state in ((0.0, 'localized'), (3.0, 'lost')):
        watch = Watch(Relocalizer(room, OPTIONS))
        for number, frame in enumerate(queries):
            pose = frame.map_from_camera.copy()
            pose[0, 3] += shift
            features = ImageFeatures(partial(np.asarray, frame.image_rgb), frame.camera)
            recognizer = ImageRecognizer(localizer, features)
            report = watch.look(Observation(
                frame.camera, NO_OBJECTS, stamp_ns=number * 10**10,
                odom_from_camera=frame.map_from_camera), pose, frame.image_rgb, recognizer)
        assert report.state == state and report.looks == len(queries) and not report.fault


def test_a_second_room_that_looks_the_same_is_refused(layer, room, queries, answer):
    world = World(room, layer, np.zeros(3))
    twins = KeyframeLocalizer(twin(1.0, 0, world, np.random.default_rng(0)).layer)
    for frame in queries[:3]:
        features = query_features(frame.image_rgb)
        seen = twins.localize_features(features, frame.camera)
        assert len(seen.places) > 1 and seen.is_complete
        # a search that time cuts short may have missed the equal room, and gives no pose
        cut = twins.localize_features(features, frame.camera, deadline=time.monotonic())
        assert not cut.places and not cut.is_complete
        assert seen.places[1].inliers > 0.5 * seen.places[0].inliers
        assert not answer(twins, frame.image_rgb, frame.camera).accepted


@pytest.fixture
def floors(layer, office, room, tmp_path):
    """Return a function that writes the layers of floors, and returns files and joined map.

    'kitchen' and 'office' name the images of a floor, '' a floor without keyframes.
    """
    seen = {'kitchen': layer, 'office': build_layer(office.select(range(0, 17, 2)), room, EVERY)}

    def write(*names):
        maps = [replace(room, frame_id=f'floor_{number}') for number in range(len(names))]
        files = [tmp_path / f'{each.frame_id}.keyframes.npz' for each in maps]
        for name, each, file in zip(names, maps, files, strict=True):
            file.unlink(missing_ok=True)
            if name:
                save_layer(file, replace(seen[name].plain(), frame_id=each.frame_id))
        return files, join_maps(maps, names)
    return write


@pytest.mark.parametrize('names', [('office', 'kitchen'), ('kitchen', 'office', 'office')])
def test_each_floor_is_found_by_its_keyframes_in_its_own_frame(names, floors, layer, queries,
                                                               answer, room):
    files, joined = floors(*names)
    both = load_layers(files, joined)
    localizer, alone = KeyframeLocalizer(both), KeyframeLocalizer(layer)
    assert len(both) == len(localizer.layer.map_from_camera) > len(layer)
    first = sum(map(len, both.parts[:names.index('kitchen')]))
    for frame in queries[:2]:
        found, part = in_its_map(answer(localizer, frame.image_rgb, frame.camera, joined), joined)
        expected = answer(alone, frame.image_rgb, frame.camera)
        assert found.accepted, found.reason
        assert part.landmark_map.frame_id == f'floor_{names.index("kitchen")}'
        for pose in (found.map_from_camera, found.recognized.map_from_camera):
            assert np.allclose(pose, expected.map_from_camera, atol=1e-3)
        assert np.allclose(found.recognized.points, expected.recognized.points, atol=1e-5)
        assert found.recognized.keyframes == tuple(
            first + row for row in expected.recognized.keyframes)
        pose = frame.map_from_camera.copy()
        assert localizer.coverage(pose, frame.camera) == (
            alone.coverage(pose, frame.camera) if first == 0 else 0.0)


def test_equal_floors_are_refused_and_a_floor_without_keyframes_turns_them_off(
        floors, queries, answer):
    files, joined = floors('kitchen', 'kitchen')
    localizer = KeyframeLocalizer(load_layers(files, joined))
    found = answer(localizer, queries[0].image_rgb, queries[0].camera, joined)
    assert not found.accepted and len(found.recognition.places) >= 2
    recognizer = ImageRecognizer(localizer, ImageFeatures(lambda: queries[0].image_rgb,
                                                          queries[0].camera), 0.0)
    assert recognizer.recognize([]).places == (), 'time is up: rivals may be missing'
    files, joined = floors('kitchen', '')
    with pytest.raises(MapError, match=r'floor_1\.keyframes\.npz: several maps need a layer each'):
        load_layers(files, joined)
    with pytest.raises(MapError, match='several maps need a layer each'):
        load_layers(files[:1], joined)  # one layer is named for both


def test_the_office_is_triangulated_without_depth(office, room, answer):
    layer = build_layer(office.select(range(0, 17, 2)), room, EVERY)
    assert (np.diff(layer.offsets) > 100).all()
    localizer = KeyframeLocalizer(layer)
    for frame in office.select(range(1, 17, 4)).read():
        found = answer(localizer, frame.image_rgb, frame.camera)
        assert found.accepted, found.reason
        assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.05
