# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""XFeat with the published file: its features, and keyframes with them."""

import http.server
import logging
import pickle
import shutil
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import openvino
import pytest
from scene import ROOM

from cliploc_ros.cli.build_map import make_parser
from cliploc_ros.cli.options import layer_options, read_layer
from cliploc_ros.cli.sources import each_recording, read_cameras
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.features import SIFT
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, query_features
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError, ModelError
from cliploc_ros.models.xfeat import FILE_NAME, any_size, feature_kinds, load_xfeat
from cliploc_ros.offline.datasets.folders import rgbd_frames
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.ros.frame_localizer import load_keyframes
from cliploc_ros.ros.parameters import RelocalizerParameters
from demo import ASSETS


@pytest.fixture(scope='module')
def published(shared_data):
    """The published file."""
    file = shared_data / 'weights' / FILE_NAME
    if not file.exists():
        pytest.skip(f'the published network is missing: {file}')
    return file


@pytest.fixture(scope='module')
def cache_dir(published, tmp_path_factory):
    """Return a cache that has the file."""
    folder = tmp_path_factory.mktemp('cache') / 'cliploc_ros'
    (folder / 'weights').mkdir(parents=True)
    (folder / 'weights' / FILE_NAME).symlink_to(published)
    return folder


@pytest.fixture(scope='module')
def xfeat(cache_dir):
    return load_xfeat(str(cache_dir))


@pytest.fixture(scope='module')
def kitchen(shared_data):
    return rgbd_frames(shared_data / 'seven_scenes_kitchen', FolderOptions())


@pytest.fixture(scope='module')
def image_rgb(kitchen):
    return next(kitchen.select([0]).read()).image_rgb


@pytest.fixture(scope='module')
def layer_file(kitchen, xfeat, tmp_path_factory):
    file = tmp_path_factory.mktemp('layer') / 'kitchen.keyframes.npz'
    save_layer(file, build_layer(kitchen.select(range(0, 30, 3)), ROOM,
                                 LayerOptions(0.0, 0.0, kind=xfeat)))
    return file


def test_in_any_size_the_network_gives_the_numbers_of_the_published_one(published):
    core = openvino.Core()
    single = {'INFERENCE_PRECISION_HINT': 'f32'}
    fixed = core.compile_model(core.read_model(published), 'CPU', single)
    free = core.compile_model(any_size(core.read_model(published)), 'CPU', single)
    image = np.random.default_rng(0).random((1, 3, 640, 640), dtype=np.float32)
    descriptors, likely, reliable = (fixed(image)[output] for output in range(3))
    descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    likely = np.exp(likely - likely.max(axis=1, keepdims=True))
    likely /= likely.sum(axis=1, keepdims=True)
    expected = np.concatenate([descriptors, likely, reliable], axis=1)
    np.testing.assert_allclose(free(image)[0], expected, atol=1e-5)
    assert free(image[:, :, :480, :320])[0].shape == (1, 130, 60, 40)


def test_features_of_a_real_image(xfeat, image_rgb):
    found = xfeat.extract(image_rgb, 500, 640)
    assert len(found) == len(found.descriptors) == 500
    assert found.descriptors.dtype == np.uint8 and found.descriptors.shape[1] == 64
    assert (np.diff(found.strengths) <= 0.0).all()
    assert ((found.pixels > -0.5) & (found.pixels < (639.5, 479.5))).all()
    # shifted by a cell of the network, the image has the same features
    moved = xfeat.extract(np.roll(image_rgb, 32, axis=1), 500, 640)
    pairs, _ = xfeat.match(xfeat.units(found.descriptors), xfeat.units(moved.descriptors))
    steps = moved.pixels[pairs[:, 1]] - found.pixels[pairs[:, 0]]
    assert np.mean(np.abs(steps - (32, 0)).max(axis=1) < 1.0) > 0.9
    assert len(pairs) > 250
    # a smaller image has features at the same places
    small = xfeat.extract(image_rgb, 500, 416)
    pairs, _ = xfeat.match(xfeat.units(found.descriptors), xfeat.units(small.descriptors))
    steps = small.pixels[pairs[:, 1]] - found.pixels[pairs[:, 0]]
    assert np.abs(np.median(steps, axis=0)).max() < 0.5


@pytest.mark.parametrize('shape', [(7, 300), (1, 1), (333, 517)])
def test_an_image_of_any_shape_has_features_inside(xfeat, shape):
    image = np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)
    found = xfeat.extract(image, 100, 400)
    assert ((found.pixels >= -0.5) & (found.pixels <= np.array(shape[::-1]) - 0.5)).all()
    assert len(xfeat.extract(np.zeros((*shape, 3), np.uint8), 100, 400).pixels) <= 100


def test_a_layer_localizes_real_images(layer_file, kitchen, cache_dir):
    layer = load_layer_of_map(layer_file, ROOM, feature_kinds(str(cache_dir)))
    assert layer.kind.name == 'xfeat-64-uint8'
    assert layer_file.stat().st_size < 60e3 * len(layer)
    localizer = KeyframeLocalizer(pickle.loads(pickle.dumps(layer)))  # as evaluate's workers do
    for frame in kitchen.select(range(1, 30, 6)).read():
        best = localizer.localize_features(query_features(frame.image_rgb, kind=layer.kind),
                                           frame.camera).places[0]
        assert pose_error(best.map_from_camera, frame.map_from_camera)[0] < 0.1
        assert best.inliers > 20


def test_features_of_different_kinds_are_not_compared(layer_file, image_rgb, cache_dir, tmp_path):
    kinds = feature_kinds(str(cache_dir))
    layer = load_layer_of_map(layer_file, ROOM, kinds)
    with pytest.raises(MapError, match='xfeat-64-uint8: extract them with the kind of the layer'):
        KeyframeLocalizer(layer).localize_features(query_features(image_rgb), layer.cameras[0])
    with pytest.raises(MapError, match=f'expected {SIFT.name}; make the layer again'):
        load_layer_of_map(layer_file, ROOM)
    mixed = tmp_path / 'mixed.npz'
    save_layer(mixed, replace(layer, kind=SIFT))
    with pytest.raises(MapError, match=r'of 64 dimensions, expected 128 for kind'):
        load_layer_of_map(mixed, ROOM, kinds)


def test_a_missing_or_another_file_is_named_with_what_to_do(layer_file, cache_dir, tmp_path,
                                                            caplog, monkeypatch):
    monkeypatch.setenv('https_proxy', 'http://127.0.0.1:9')  # no server listens on the port
    with pytest.raises(ModelError, match=r'Without a network: download https.*keyframe-features'):
        load_xfeat(str(tmp_path))
    parameters = RelocalizerParameters(keyframes_file=str(layer_file), cache_dir=str(cache_dir))
    assert len(load_keyframes(parameters, ROOM).localizer.layer) == 10
    parameters = replace(parameters, cache_dir=str(tmp_path))
    with caplog.at_level(logging.ERROR):
        assert load_keyframes(parameters, ROOM) is None
    assert 'without keyframes: cannot download xfeat.onnx' in caplog.text
    assert list((tmp_path / 'weights').iterdir()) == []
    (tmp_path / 'weights' / FILE_NAME).write_bytes(b'<html>')
    with pytest.raises(ModelError, match=r'is not the published XFeat.* remove it'):
        load_xfeat(str(tmp_path))


def test_only_the_published_file_is_kept_of_a_download(published, tmp_path, monkeypatch):
    served = tmp_path / 'served'
    served.mkdir()
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=served)
    with http.server.HTTPServer(('127.0.0.1', 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setattr(
            'cliploc_ros.models.xfeat._URL', f'http://127.0.0.1:{server.server_port}/{FILE_NAME}')
        (served / FILE_NAME).write_bytes(published.read_bytes()[:-1])
        with pytest.raises(ModelError, match='the server sent another file'):
            load_xfeat(str(tmp_path))
        assert list((tmp_path / 'weights').iterdir()) == []
        shutil.copy(published, served / FILE_NAME)
        assert load_xfeat(str(tmp_path)).dimensions == 64
        server.shutdown()
    assert (tmp_path / 'weights' / FILE_NAME).read_bytes() == published.read_bytes()


def test_programs_take_the_kind_from_the_layer(cache_dir, tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(cache_dir.parent))
    shutil.copy(ASSETS / 'map.yaml', tmp_path)
    landmark_map = LandmarkMap.from_file(tmp_path / 'map.yaml')
    options = make_parser().parse_args([
        '--tum', str(ASSETS / 'mapping'), '--keyframe-features', 'xfeat', '--keyframe-layer',
        '--out', str(tmp_path / 'map.yaml')])
    save_layer(layer_path(options.out), build_layer(
        read_cameras(each_recording(options)[0])[''], landmark_map, layer_options(options)[0]))
    assert read_layer([options.out], landmark_map, wanted=True).kind.dimensions == 64
