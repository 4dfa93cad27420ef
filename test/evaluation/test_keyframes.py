# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of real images: the kitchen with depth, the office without."""

import time

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes import localization
from cliploc_ros.core.keyframes.layer_file import load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, query_features
from cliploc_ros.core.keyframes.recognizer import ImageRecognizer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.folders import FolderOptions, rgbd_frames, tum_frames
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer
from studies.keyframes.cases import IMAGE_CHANGES, World, hang, make_picture, twin

EVERY = LayerOptions(0.0, 0.0)
OPTIONS = RelocalizerOptions(matching='class')
NO_BOXES = Detections(np.empty((0, 4)), (), np.empty(0))
MAPPED, ASKED = range(0, 30, 3), range(1, 30, 6)


@pytest.fixture(scope='module')
def room(shared_data):
    """Any map: the tests look at features alone."""
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office' / 'map.yaml')


@pytest.fixture(scope='module')
def kitchen(shared_data):
    return rgbd_frames(shared_data / 'seven_scenes_kitchen', FolderOptions())


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    return tum_frames(read_tum(folder), find_camera(None, folder)[0])


@pytest.fixture(scope='module')
def queries(kitchen):
    return list(kitchen.select(ASKED).read())


@pytest.fixture(scope='module')
def layer(kitchen, room, tmp_path_factory):
    """Ten images of the kitchen, written and read."""
    path = tmp_path_factory.mktemp('layer') / 'kitchen.keyframes.npz'
    save_layer(path, build_layer(kitchen.select(MAPPED), room, EVERY))
    assert path.stat().st_size < 5e6 * len(MAPPED) / 50
    return load_layer_of_map(path, room)


@pytest.fixture(scope='module')
def answer(room):
    """Localizes an image without objects."""
    relocalizer = Relocalizer(room, OPTIONS)

    def locate(localizer, image_rgb, camera):
        return relocalizer.locate(
            [relocalizer.search(Observation(camera, NO_BOXES))],
            recognizer=ImageRecognizer(localizer, query_features(image_rgb), camera))
    return locate


def test_the_kitchen_is_found_to_centimetres_and_accepted(layer, queries, answer):
    localizer = KeyframeLocalizer(layer)
    for frame in queries:
        found = answer(localizer, frame.image_rgb, frame.camera)
        assert found.accepted, found.reason
        assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.1
        assert np.sqrt(np.trace(found.covariance[:3, :3])) < 0.1


@pytest.mark.parametrize('name', ['dark and noisy', 'blurred', 'unevenly lit', 'half covered'])
def test_changed_images_are_found(layer, queries, answer, name):
    localizer, frame = KeyframeLocalizer(layer), queries[0]
    image = IMAGE_CHANGES[name](frame.image_rgb, frame.image_rgb, np.random.default_rng(0))
    found = answer(localizer, np.clip(image, 0, 255).astype(np.uint8), frame.camera)
    assert found.map_from_camera is not None
    assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.25


def test_another_room_is_refused(layer, office, answer):
    localizer = KeyframeLocalizer(layer)
    for frame in office.select(range(0, 17, 4)).read():
        assert not answer(localizer, frame.image_rgb, frame.camera).accepted


@pytest.fixture
def twins(layer, room):
    world = World(room, layer, np.zeros(3))
    return KeyframeLocalizer(twin(1.0, 0, world, np.random.default_rng(0)).layer)


def test_a_second_room_that_looks_the_same_is_refused(twins, queries, answer):
    for frame in queries[:3]:
        seen = twins.localize(frame.image_rgb, frame.camera)
        assert seen.rival > 0.5 * seen.places[0].inliers
        assert not answer(twins, frame.image_rgb, frame.camera).accepted


def test_a_poster_of_another_place_is_refused(layer, queries, kitchen, answer):
    elsewhere = next(kitchen.select([27]).read())  # mapped
    frame = queries[0]
    picture = make_picture('crop', 0.3, frame.camera, elsewhere.image_rgb, frame.camera,
                           np.random.default_rng(0))
    image = hang(frame.image_rgb, picture, frame.camera, np.eye(4))
    found = answer(KeyframeLocalizer(layer), image, frame.camera)
    assert not found.accepted or pose_error(found.map_from_camera,
                                            frame.map_from_camera)[0] < 1.0


def test_a_search_that_time_cuts_short_gives_no_pose(twins, queries):
    """It might have missed the same room elsewhere."""
    localizer, frame = twins, queries[0]
    features = query_features(frame.image_rgb)
    found = []
    for wait_s in np.linspace(0.0, 0.2, 21):
        seen = localizer.localize_features(features, frame.camera,
                                           deadline=time.monotonic() + wait_s)
        found.append(seen.is_complete)
        assert seen.is_complete == bool(seen.places)
        assert not seen.places or seen.rival > 0.5 * seen.places[0].inliers
    assert not found[0]
    assert localizer.localize_features(features, frame.camera).is_complete


def test_a_weak_pose_gets_more_keyframes(layer, queries, monkeypatch):
    localizer, frame = KeyframeLocalizer(layer), queries[2]
    monkeypatch.setattr(localization, '_SIMILAR', 1)
    monkeypatch.setattr(localization, '_ELSEWHERE', 0)
    monkeypatch.setattr(localization, '_ENOUGH_INLIERS', 0)
    few = localizer.localize(frame.image_rgb, frame.camera).places[0]
    monkeypatch.setattr(localization, '_ENOUGH_INLIERS', few.inliers + 1)
    more = localizer.localize(frame.image_rgb, frame.camera).places[0]
    assert len(few.keyframes) == 1 < len(more.keyframes)
    assert more.inliers > few.inliers


def test_a_guess_brings_in_keyframes_that_are_not_similar(layer, queries):
    localizer = KeyframeLocalizer(layer)
    frame = queries[0]
    with_guess = localizer.localize(frame.image_rgb, frame.camera, [frame.map_from_camera])
    without = localizer.localize(frame.image_rgb, frame.camera)
    assert with_guess.places[0].inliers >= without.places[0].inliers


def test_the_office_is_triangulated_without_depth(office, room, answer):
    layer = build_layer(office.select(range(0, 17, 2)), room, EVERY)
    assert (np.diff(layer.offsets) > 100).all()
    localizer = KeyframeLocalizer(layer)
    for frame in office.select(range(1, 17, 4)).read():
        found = answer(localizer, frame.image_rgb, frame.camera)
        assert found.accepted, found.reason
        assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.05
