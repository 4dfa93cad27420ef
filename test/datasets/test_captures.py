# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of other programs and devices give the same images, poses and map as the original."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from capture_folders import (
    ASSETS,
    DEPTH_MM,
    WALK,
    WRITERS,
    shots_of,
    write_colmap,
    write_nerf,
    write_stray,
)

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.offline.datasets.captures.capture import FolderOptions
from cliploc_ros.offline.datasets.folders import find_layout, read_folder
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.make_map import scale_of_objects
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.recording.networks import RunNetworks
from cliploc_ros.offline.recording.recorder import record_every_frame

pytestmark = pytest.mark.needs('pycolmap')
METRES = FolderOptions(scale=1.0)
OPTIONS = MappingOptions(min_baseline_deg=5.0, estimate_pose_errors=False)


@pytest.fixture(scope='session')
def look():
    """Return the demo's detector, which runs once on equal pixels."""
    detect, seen = load_detector(DetectorOptions(model=str(ASSETS / 'yolo.onnx'))).detect, {}

    def once(image):
        key = image.tobytes()
        if key not in seen:
            seen[key] = detect(image)
        return seen[key]
    return RunNetworks(once)


@pytest.fixture(scope='session')
def recorded(look):
    """Return the detections of the walk as a TUM folder."""
    return record_every_frame(read_folder(WALK, FolderOptions(layout='tum')), look)


@pytest.fixture(scope='session')
def original(recorded):
    """Its map."""
    return build_map(recorded, OPTIONS).landmark_map


@pytest.fixture(scope='session')
def shots():
    return shots_of()


@pytest.mark.parametrize('layout', WRITERS)
def test_what_is_seen_and_from_where_is_that_of_the_original(layout, shots, look, recorded,
                                                             tmp_path):
    folder = WRITERS[layout](tmp_path / 'scan', shots)
    assert find_layout(folder).name == layout
    frames = read_folder(folder, METRES)
    assert frames.notes[0] == f'read as {layout}: {len(shots)} of {len(shots)} images have poses'
    for raw, shot in zip(frames.read_raw(lambda *_: True), shots, strict=True):
        assert max(pose_error(raw.map_from_camera, shot.pose)) < 1e-4
        np.testing.assert_allclose(raw.color.args[0].camera.matrix, shot.camera.matrix, atol=1e-6)
        if layout not in ('COLMAP model', 'transforms.json'):
            assert abs(raw.stamp_ns - shot.stamp_ns) < 2_000
    has_depth = layout in ('Polycam', 'Stray Scanner', 'ARKitScenes')
    assert (raw.depth is not None) == has_depth
    if has_depth:
        depths = raw.depth().depths_m
        assert depths.shape == DEPTH_MM.shape and depths[-1, -1] == 2.0
        # where Polycam's confidence is low
        assert np.isnan(depths[0, 0]) == (layout == 'Polycam')
    # flat depth does not match this room
    seen = record_every_frame(frames, lambda raw: look(replace(raw, depth=None)))
    assert len(seen.classes) > 200
    np.testing.assert_array_equal(seen.frames, recorded.frames)
    np.testing.assert_array_equal(seen.classes, recorded.classes)
    np.testing.assert_allclose(seen.bboxes_xyxy, recorded.bboxes_xyxy, atol=1e-3)


def test_text_models_and_per_frame_intrinsics_say_the_same(shots, tmp_path):
    for text in (False, True):
        write_colmap(tmp_path / f'{text}', shots[:5], text)
    write_nerf(tmp_path / 'nerf', shots[:5], per_frame=True)
    # without points, every second line is empty
    bare = write_colmap(tmp_path / 'bare', shots[:5], text=True) / 'sparse/0/images.txt'
    lines = bare.read_text().splitlines()
    first = next(row for row, line in enumerate(lines) if not line.startswith('#'))
    bare.write_text('\r\n'.join([*lines[:first], *(
        '' if row % 2 else line for row, line in enumerate(lines[first:]))]))
    for folder in ('bare', 'False', 'True', 'nerf', 'True/sparse/0', 'nerf/transforms.json'):
        frames = read_folder(tmp_path / folder, METRES)
        poses = [raw.map_from_camera for raw in frames.read_raw(lambda *_: True)]
        np.testing.assert_allclose(poses, [shot.pose for shot in shots[:5]], atol=1e-9)


@pytest.mark.parametrize(('model', 'values'), [
    ('PINHOLE', [500, 505, 318, 244]), ('SIMPLE_RADIAL', [500, 320, 240, 0.1]),
    ('OPENCV', [500, 505, 318, 244, 0.1, -0.05, 0.001, -0.002]),
    ('FULL_OPENCV', [500, 505, 318, 244, 0.1, -0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003]),
    ('OPENCV_FISHEYE', [300, 305, 318, 244, 0.1, -0.05, 0.01, -0.002]),
    ('FISHEYE', [300, 305, 318, 244])])
def test_camera_models_project_as_colmap_does(model, values, shots, tmp_path):
    import pycolmap

    write_colmap(tmp_path, shots[:1], camera_of=lambda _: (model, 640, 480, values))
    raw = next(read_folder(tmp_path, METRES).read_raw(lambda *_: True))
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=values)
    points = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.4, 0.0, 0.4]), -1).reshape(-1, 2)
    expected = [theirs.img_from_cam(np.array([*point, 1.0])) for point in points]
    np.testing.assert_allclose(raw.color.args[0].camera.project_normalized(points) + 0.5,
                               expected, atol=1e-6)


def test_images_with_their_own_cameras(shots, look, tmp_path):
    """A phone that focuses, and one image of another size: boxes are converted exactly."""
    focus = 1.0 + 0.004 * np.sin(np.arange(len(shots) + 1))

    def camera_of(number):
        return 'PINHOLE', 640, 480, [500 * focus[number], 500 * focus[number], 320 + number / 9,
                                     240]
    folder = write_colmap(tmp_path, shots, camera_of=camera_of)
    frames = read_folder(folder, METRES)
    assert frames.varies
    recorded = record_every_frame(frames, look)
    assert len(recorded.cameras) == 1 and recorded.open_edges is not None
    own = Camera(640, 480, 500 * focus[4], 500 * focus[4], 320 + 4 / 9 - 0.5, 239.5)
    boxes = look.detect(next(read_folder(folder, METRES).select([3]).read()).image_rgb)
    rows = slice(*recorded.frame_offsets[3:5])
    np.testing.assert_allclose(
        recorded.cameras[0].normalize_bboxes(recorded.bboxes_xyxy[rows]),
        own.normalize_bboxes(boxes.bboxes_xyxy), atol=1e-9)
    # a rotated image has a separate camera, in the file as well
    image = folder / 'images/walk' / shots[0].path.name
    cv2.imwrite(str(image), np.zeros((640, 480, 3), dtype=np.uint8))
    other = write_colmap(tmp_path / 'other', shots, camera_of=lambda number: (
        ('PINHOLE', 480, 640, [500, 500, 240, 320]) if number == 1 else camera_of(number)))
    cv2.imwrite(str(other / 'images/walk' / shots[0].path.name),
                np.zeros((640, 480, 3), dtype=np.uint8))
    recorded = record_every_frame(read_folder(other, METRES), look)
    save_observations(tmp_path / 'o.npz', recorded)
    again = load_observations(tmp_path / 'o.npz')
    assert again.camera_names == ('1: 480x640', '2: 640x480')
    assert again.frame_cameras.tolist() == [0] + [1] * (len(shots) - 1)
    made = build_map(again, OPTIONS).landmark_map
    assert isinstance(made, LandmarkMap) and len(made) > 20


def test_a_video_is_read_image_by_image(shots, tmp_path):
    write_stray(tmp_path, shots[:6])
    for path in (tmp_path / 'rgb').iterdir():
        path.unlink()
    video = cv2.VideoWriter(str(tmp_path / 'rgb.mp4'), cv2.VideoWriter.fourcc(*'mp4v'), 30.0,
                            (640, 480))
    for number in range(6):
        video.write(np.full((480, 640, 3), 40 * number, dtype=np.uint8))
    video.release()
    frames = read_folder(tmp_path)
    assert [round(float(frame.image_rgb.mean()) / 40) for frame in frames.read()] == [*range(6)]
    one, = frames.select([2]).read()  # back
    assert round(float(one.image_rgb.mean()) / 40) == 2


def test_the_scale_by_a_distance_and_by_objects(shots, look, original, tmp_path):
    folder = write_colmap(tmp_path, shots, scale=0.4)
    first, last = shots[0], shots[-1]
    apart = float(np.linalg.norm(first.pose[:3, 3] - last.pose[:3, 3]))
    frames = read_folder(folder, FolderOptions(
        known_distance=(first.path.name, f'walk/{last.path.name}', apart)))
    assert any('0.4 m' in note for note in frames.notes)
    detections = record_every_frame(read_folder(folder, FolderOptions(any_unit=True)),
                                    look)
    rows = [row for row, name in enumerate(original.class_ids) if name == 'book']
    metres = float(np.median(2.0 * original.semi_axes[rows].max(axis=1)))
    scale, objects = scale_of_objects(detections, OPTIONS, 'book', metres)
    assert scale == pytest.approx(0.4, rel=0.02) and objects == len(rows)
    with pytest.raises(MappingError, match="'unicorn'"):
        scale_of_objects(detections, OPTIONS, 'unicorn', metres)
