# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of other programs and devices give the same images, poses and map as the original.

Camera axes are found from the images, the vertical from the tilt of the cameras. Faults give a
message that names the necessary fix, whatever the bytes are.
"""

import itertools
import shutil
import struct
import time
import tracemalloc
from functools import partial

import capture_folders as captures
import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError, DatasetError, MappingError
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.offline.datasets import agreement
from cliploc_ros.offline.datasets.folders import AXES, check_axes, find_layout, read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.make_map import scale_of_objects
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.tilt import find_levelling, find_vertical, tilt_note
from cliploc_ros.offline.recording.networks import run_networks
from cliploc_ros.offline.recording.recorder import record_every_frame

pytestmark = pytest.mark.needs('pycolmap')
METRES = FolderOptions(scale=1.0)
OPTIONS = MappingOptions(min_baseline_deg=5.0, estimate_pose_errors=False)


@pytest.fixture(scope='session')
def look():
    """Return the demo's detector, which runs once on equal pixels."""
    network = load_detector(DetectorOptions(model=str(captures.ASSETS / 'yolo.onnx')))
    return partial(run_networks, captures.once_for_each(network.detect), None)


@pytest.fixture(scope='session')
def original(look):
    """Return the map of the walk as a TUM folder."""
    walk = read_folder(captures.WALK, FolderOptions(layout='tum'))
    return build_map(record_every_frame(walk, look), OPTIONS).landmark_map


@pytest.fixture(scope='session')
def shots():
    return captures.shots_of()


@pytest.mark.parametrize('layout', captures.WRITERS)
def test_what_is_seen_and_from_where_is_that_of_the_original(layout, shots, tmp_path):
    folder = captures.WRITERS[layout](tmp_path / 'scan', shots)
    assert find_layout(folder).name == layout
    frames = read_folder(folder, METRES)
    assert frames.notes[0] == f'read as {layout}: {len(shots)} of {len(shots)} images have poses'
    for raw, shot in zip(frames.read_raw(lambda *_: True), shots, strict=True):
        assert max(pose_error(raw.map_from_camera, shot.pose)) < 1e-4
        np.testing.assert_allclose(raw.color.args[0].camera.matrix, shot.camera.matrix, atol=1e-6)
        if layout not in ('COLMAP model', 'transforms.json'):
            assert abs(raw.stamp_ns - shot.stamp_ns) < 2_000
    assert (raw.depth is not None) == (layout in ('Polycam', 'Stray Scanner', 'ARKitScenes'))
    if raw.depth is not None:
        depths = raw.depth().depths_m
        assert depths.shape == captures.DEPTH_MM.shape and depths[-1, -1] == 2.0
        # where Polycam's confidence is low
        assert np.isnan(depths[0, 0]) == (layout == 'Polycam')
    np.testing.assert_array_equal(raw.color()[0], cv2.imread(str(shot.path))[..., ::-1])


def test_text_models_and_per_frame_intrinsics_say_the_same(shots, tmp_path):
    for text in (False, True):
        captures.write_colmap(tmp_path / f'{text}', shots[:5], text)
    captures.write_nerf(tmp_path / 'nerf', shots[:5], per_frame=True)
    # without points, every second line is empty
    bare = captures.write_colmap(tmp_path / 'bare', shots[:5], text=True) / 'sparse/0/images.txt'
    lines = bare.read_text().splitlines()
    first = next(row for row, line in enumerate(lines) if not line.startswith('#'))
    bare.write_text('\r\n'.join([*lines[:first], *(
        '' if row % 2 else line for row, line in enumerate(lines[first:]))]))
    for folder in ('bare', 'False', 'True', 'nerf', 'True/sparse/0', 'nerf/transforms.json'):
        frames = read_folder(tmp_path / folder, METRES)
        poses = [raw.map_from_camera for raw in frames.read_raw(lambda *_: True)]
        np.testing.assert_allclose(poses, [shot.pose for shot in shots[:5]], atol=1e-9)


@pytest.mark.parametrize(('model', 'values'), [
    ('SIMPLE_RADIAL', [500, 320, 240, 0.1]),
    ('OPENCV', [500, 505, 318, 244, 0.1, -0.05, 0.001, -0.002]),
    ('FULL_OPENCV', [500, 505, 318, 244, 0.1, -0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003]),
    ('OPENCV_FISHEYE', [300, 305, 318, 244, 0.1, -0.05, 0.01, -0.002]),
    ('FISHEYE', [300, 305, 318, 244])])
def test_camera_models_project_as_colmap_does(model, values, shots, tmp_path):
    import pycolmap

    captures.write_colmap(tmp_path, shots[:1], camera_of=lambda _: (model, 640, 480, values))
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
    folder = captures.write_colmap(tmp_path, shots, camera_of=camera_of)
    frames = read_folder(folder, METRES)
    assert frames.varies
    recorded = record_every_frame(frames, look)
    assert len(recorded.cameras) == 1 and recorded.open_edges is not None
    own = Camera(640, 480, 500 * focus[4], 500 * focus[4], 320 + 4 / 9 - 0.5, 239.5)
    boxes = look.args[0](next(read_folder(folder, METRES).select([3]).read()).image_rgb)
    rows = slice(*recorded.frame_offsets[3:5])
    np.testing.assert_allclose(
        recorded.cameras[0].normalize_bboxes(recorded.bboxes_xyxy[rows]),
        own.normalize_bboxes(boxes.bboxes_xyxy), atol=1e-9)
    # a rotated image has a separate camera, in the file as well
    other = captures.write_colmap(tmp_path / 'other', shots, camera_of=lambda number: (
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
    captures.write_stray(tmp_path, shots[:6])
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
    folder = captures.write_colmap(tmp_path, shots, scale=0.4)
    first, last = shots[0], shots[-1]
    apart = float(np.linalg.norm(first.pose[:3, 3] - last.pose[:3, 3]))
    frames = read_folder(folder, FolderOptions(
        known_distance=(first.path.name, f'walk/{last.path.name}', apart)))
    assert any('0.4 m' in note for note in frames.notes)
    detections = record_every_frame(read_folder(folder, FolderOptions(any_unit=True)), look)
    rows = [row for row, name in enumerate(original.class_ids) if name == 'book']
    metres = float(np.median(2.0 * original.semi_axes[rows].max(axis=1)))
    scale, objects = scale_of_objects(detections, OPTIONS, 'book', metres)
    assert scale == pytest.approx(0.4, rel=0.02) and objects == len(rows)
    with pytest.raises(MappingError, match="'unicorn'"):
        scale_of_objects(detections, OPTIONS, 'unicorn', metres)


# ---- axes and vertical --------------------------------------------------------------------------
# of a camera in a body with x forward, y left, z up
ROS_FROM_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
STORED = {'opencv': lambda pose: pose, 'opengl': lambda pose: pose @ captures.FLIP,
          'opencv-inverse': invert_transform,
          'opengl-inverse': lambda pose: invert_transform(pose @ captures.FLIP),
          'ros': lambda pose: pose @ ROS_FROM_CAMERA}


@pytest.mark.parametrize('folder', ['seven_scenes_kitchen', 'rooms/hololens_office'])
def test_real_images_tell_the_axes(folder, shared_data, monkeypatch):
    """Real poses pass; each wrong choice of axes is detected, and the correct one named."""
    folder = shared_data / folder
    capture = find_layout(folder).read(folder, FolderOptions())
    extract, known = agreement.extract, {}

    def once(image, *more):  # since that takes most of the time
        key = image.tobytes()
        if key not in known:
            known[key] = extract(image, *more)
        return known[key]
    monkeypatch.setattr(agreement, 'extract', once)
    for stored_as, stated in itertools.product(AXES, AXES):
        stored = [file._replace(pose=STORED[stored_as](file.pose)) for file in capture.files
                  if file.pose is not None]
        if stated == stored_as:
            assert check_axes(stored, stated, folder) == ''
            continue
        with pytest.raises(DatasetError, match=f'poses as {stated} .*`axes` {stored_as}$'):
            check_axes(stored, stated, folder)


def test_the_option_mends_it(shots, tmp_path):
    folder = captures.write_nerf(tmp_path, [shot._replace(pose=shot.pose @ captures.FLIP)
                                            for shot in shots])
    with pytest.raises(DatasetError, match='`axes` opencv'):
        read_folder(folder, FolderOptions(scale=1.0))
    found = next(read_folder(folder, FolderOptions(scale=1.0, axes='opencv')).read())
    np.testing.assert_allclose(found.map_from_camera, shots[0].pose, atol=1e-9)


def test_an_upside_down_camera_is_no_reason_to_turn_the_map_over():
    poses = np.tile(np.eye(4), (12, 1, 1))
    turns = Rotation.from_euler('xz', [[-90.0, 30.0 * place] for place in range(12)], degrees=True)
    poses[:, :3, :3] = turns.as_matrix()
    assert tilt_note(poses) == ''
    poses[:, :3, :3] = turns.as_matrix() @ np.diag([-1.0, -1.0, 1.0])
    assert 'mounted so' in tilt_note(poses) and 'corrects' not in tilt_note(poses)
    assert tilt_note(poses, of_robot=True) == ''
    np.testing.assert_allclose(find_levelling(poses, True, of_robot=True)[0], np.eye(3), atol=1e-9)


@pytest.mark.parametrize('angles_deg', [(120.0, 0.0, 30.0), (1.0, -1.0, 100.0)])
def test_levelled_by_the_tilt_of_the_cameras(angles_deg, shots, tmp_path):
    world = make_transform(Rotation.from_euler('xyz', angles_deg, degrees=True).as_matrix(),
                           np.array([1.0, 2.0, 3.0]))
    folder = captures.write_colmap(tmp_path, shots, world=world)
    plain = read_folder(folder, FolderOptions(scale=1.0))
    up = world[:3, 2]
    tilt_deg = np.degrees(np.arccos(up[2]))
    assert any('--level corrects it' in note for note in plain.notes) == (tilt_deg > 5.0 + 1.0)
    frames = read_folder(folder, FolderOptions(scale=1.0, level=True))
    note, = (note for note in frames.notes if note.startswith('levelled'))
    assert float(note.split(' was ')[1].split()[0]) == pytest.approx(tilt_deg, abs=3.0)
    for raw, shot in zip(frames.read_raw(lambda *_: True), shots, strict=True):
        # the camera's tilt is that of the room, whose z axis is up
        down, true_down = raw.map_from_camera[2, :3], shot.pose[2, :3]
        assert np.degrees(np.arccos(np.clip(down @ true_down, -1, 1))) < 3.0


def test_cameras_that_do_not_tell_the_vertical(shots, tmp_path):
    poses = np.array([shot.pose for shot in shots])
    assert np.degrees(np.arccos(find_vertical(poses)[2])) < 3.0
    assert find_vertical(np.tile(poses[:1], (9, 1, 1))) is None, 'never turns'
    on_its_side = poses @ make_transform(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix(),
                                         np.zeros(3))
    assert find_vertical(on_its_side) is None
    folder = captures.write_colmap(tmp_path, [shot._replace(pose=poses[0]) for shot in shots])
    with pytest.raises(DatasetError, match='the vertical'):
        read_folder(folder, FolderOptions(scale=1.0, level=True))


# ---- faults -------------------------------------------------------------------------------------
@pytest.fixture(scope='module')
def few(shots):
    return shots[:4]


def refuses(folder, expected, options=METRES):
    with pytest.raises(DatasetError, match=expected):
        for frame in read_folder(folder, options).read():
            assert frame is not None


@pytest.mark.parametrize('name', ['..', 'C:\\', 'a\0b'])
def test_names_of_no_file_are_counted(name, few, tmp_path):
    folder = captures.write_nerf(tmp_path, few)
    captures.edited(folder, lambda values: values['frames'][0].update(file_path=name))
    assert any('1 of 4 listed images are missing' in note
               for note in read_folder(folder, METRES).notes)


def test_folders_without_poses_or_images(few, tmp_path):
    refuses(tmp_path / 'gone', 'no such folder')
    (tmp_path / 'photos').mkdir()
    shutil.copy(few[0].path, tmp_path / 'photos')
    refuses(tmp_path / 'photos', 'images without poses')
    (tmp_path / 'scan.r3d').touch()
    refuses(tmp_path / 'scan.r3d', 'unpack it')
    (tmp_path / 'photos/metadata.yaml').touch()
    refuses(tmp_path / 'photos', '`bag`')
    refuses(tmp_path / 'photos', 'has no COLMAP model', FolderOptions(layout='colmap'))
    folder = captures.write_colmap(tmp_path / 'scan', few)
    shutil.move(folder / 'images', tmp_path / 'moved')
    refuses(folder, 'none of 4 .* `images`')
    found = read_folder(folder, FolderOptions(scale=1.0, images=tmp_path / 'moved'))
    assert found.count == 4
    (tmp_path / 'moved/walk' / few[0].path.name).unlink()
    notes = read_folder(folder, FolderOptions(scale=1.0, images=tmp_path / 'moved')).notes
    assert any('1 of 4 listed images' in note for note in notes)


def test_the_unit_must_be_known(few, tmp_path):
    refuses(captures.write_colmap(tmp_path / 'c', few), '`scale`', FolderOptions())
    refuses(tmp_path / 'c', 'named z.jpg',
            FolderOptions(known_distance=('z.jpg', few[1].path.name, 1.0)))
    name = few[0].path.name
    refuses(tmp_path / 'c', 'at the same place', FolderOptions(known_distance=(name, name, 1.0)))
    refuses(captures.write_nerf(tmp_path / 'z', few, applied_scale=0), 'applied_scale is 0')
    doubled = [shot._replace(pose=make_transform(shot.pose[:3, :3], 2.0 * shot.pose[:3, 3]))
               for shot in few]
    folder = captures.write_nerf(tmp_path / 'n', doubled, applied_scale=2.0)
    raws = read_folder(folder, METRES).read_raw(lambda *_: True)
    np.testing.assert_allclose(next(raws).map_from_camera, few[0].pose, atol=1e-9)


def test_models_in_pieces_and_turned_images(few, tmp_path):
    folder = captures.write_colmap(tmp_path / 'a', few)
    other = captures.write_colmap(tmp_path / 'b', few[:1])
    shutil.move(other / 'sparse/0', folder / 'sparse/1')
    assert any('2 pieces' in note for note in read_folder(folder, METRES).notes)
    path = folder / 'images/walk' / few[0].path.name
    cv2.imwrite(str(path), np.zeros((640, 480, 3), dtype=np.uint8))
    refuses(folder, '480x640 px.*EXIF')


def test_false_counts_cost_nothing(few, tmp_path):
    folder = captures.write_colmap(tmp_path, few)
    for name in ('cameras.bin', 'images.bin'):
        path = folder / 'sparse/0' / name
        data = path.read_bytes()
        tracemalloc.start()
        path.write_bytes(struct.pack('<Q', 2**62) + data[8:])
        refuses(folder, f'{name}: .*{2**62}')
        assert tracemalloc.get_traced_memory()[1] < 2e6
        tracemalloc.stop()
        path.write_bytes(data)


@pytest.mark.parametrize(('edit', 'expected'), [
    (lambda v: v.update(fl_y=0), 'fy=0 .* focal lengths must be positive'),
    (lambda v: v.update(fl_y=1e-158), 'all values plausible pixels'),
    (lambda v: v.update(depth_unit_scale_factor=-1), 'unit of depth is -1'),
    (lambda v: v.update(applied_scale=1e-300), 'm from the origin'),
    (lambda v: v.pop('frames'), 'lists no frames'),
    (lambda v: v.pop('fl_x'), 'no intrinsics'),
    (lambda v: v.update(camera_model='EQUIRECTANGULAR'), 'EQUIRECTANGULAR'),
    (lambda v: v['frames'][0].update(transform_matrix=[[1, 0], [0, 1]]), 'transform_matrix is'),
    (lambda v: v['frames'][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
     'it is a reflection'),
    (lambda v: v['frames'][0].update(transform_matrix=[[np.nan] * 4] * 4), 'of shape')])
def test_faults_of_transforms_json(edit, expected, few, tmp_path):
    refuses(captures.edited(captures.write_nerf(tmp_path, few), edit), expected)


MUTATIONS = st.lists(st.tuples(st.floats(0.0, 0.999), st.binary(max_size=12)), max_size=6)


@pytest.mark.parametrize('layout', [*captures.WRITERS, 'text'])
def test_any_bytes_end_in_a_message(layout, few, tmp_path_factory):
    folder = tmp_path_factory.mktemp('fuzz') / 'scan'
    if layout == 'text':
        captures.write_colmap(folder, few[:2], text=True)
    else:
        captures.WRITERS[layout](folder, few[:2])
    files = {path: path.read_bytes() for path in sorted(folder.rglob('*'))
             if path.is_file() and path.suffix not in ('.jpg', '.png')
             and not path.stem.startswith(('points', 'rigs', 'frames'))}

    @settings(max_examples=40, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(sorted(files)), MUTATIONS, st.none() | st.floats(0.0, 1.0))
    def check(path, mutations, cut):
        data = bytearray(files[path])
        for place, piece in mutations:
            begin = int(place * len(data))
            data[begin:begin + len(piece)] = piece
        begin = time.monotonic()
        try:
            path.write_bytes(data[:None if cut is None else int(cut * len(data))])
            frames = read_folder(folder, METRES)
            for raw in frames.read_raw(lambda *_: True):
                raw.decode()
        except CliplocError:
            pass
        finally:
            path.write_bytes(files[path])
        assert time.monotonic() - begin < 20.0
    check()
