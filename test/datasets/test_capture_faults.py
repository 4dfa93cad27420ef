# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of folders give a message that names the necessary fix, whatever the bytes are."""

import json
import shutil
import struct
import time
import tracemalloc

import cv2
import numpy as np
import pytest
from capture_folders import WRITERS, shots_of, write_colmap, write_nerf
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions

pytestmark = pytest.mark.needs('pycolmap')
METRES = FolderOptions(scale=1.0)


@pytest.fixture(scope='module')
def shots():
    return shots_of()[:4]


def refuses(folder, expected, options=METRES):
    with pytest.raises(DatasetError, match=expected):
        for frame in read_folder(folder, options).read():
            assert frame is not None


def edited(folder, edit, name='transforms.json'):
    values = json.loads((folder / name).read_text())
    edit(values)
    (folder / name).write_text(json.dumps(values))
    return folder


@pytest.mark.parametrize('name', ['..', 'C:\\', 'a\0b'])
def test_names_of_no_file_are_counted(name, shots, tmp_path):
    folder = edited(write_nerf(tmp_path, shots), lambda values: values['frames'][0].update(
        file_path=name))
    assert any('1 of 4 listed images are missing' in note
               for note in read_folder(folder, METRES).notes)


def test_folders_without_poses_or_images(shots, tmp_path):
    refuses(tmp_path / 'gone', 'no such folder')
    (tmp_path / 'photos').mkdir()
    shutil.copy(shots[0].path, tmp_path / 'photos')
    refuses(tmp_path / 'photos', 'images without poses')
    (tmp_path / 'scan.r3d').touch()
    refuses(tmp_path / 'scan.r3d', 'unpack it')
    (tmp_path / 'photos/metadata.yaml').touch()
    refuses(tmp_path / 'photos', '`bag`')
    refuses(tmp_path / 'photos', 'has no COLMAP model', FolderOptions(layout='colmap'))
    folder = write_colmap(tmp_path / 'scan', shots)
    shutil.move(folder / 'images', tmp_path / 'moved')
    refuses(folder, 'none of 4 .* `images`')
    found = read_folder(folder, FolderOptions(scale=1.0, images=tmp_path / 'moved'))
    assert found.count == 4
    (tmp_path / 'moved/walk' / shots[0].path.name).unlink()
    notes = read_folder(folder, FolderOptions(scale=1.0, images=tmp_path / 'moved')).notes
    assert any('1 of 4 listed images' in note for note in notes)


def test_the_unit_must_be_known(shots, tmp_path):
    refuses(write_colmap(tmp_path / 'c', shots), '`scale`', FolderOptions())
    refuses(tmp_path / 'c', 'named z.jpg',
            FolderOptions(known_distance=('z.jpg', shots[1].path.name, 1.0)))
    name = shots[0].path.name
    refuses(tmp_path / 'c', 'at the same place',
            FolderOptions(known_distance=(name, name, 1.0)))
    refuses(write_nerf(tmp_path / 'z', shots, applied_scale=0), 'applied_scale is 0')
    doubled = [shot._replace(pose=make_transform(shot.pose[:3, :3], 2.0 * shot.pose[:3, 3]))
               for shot in shots]
    raws = read_folder(write_nerf(tmp_path / 'n', doubled, applied_scale=2.0), METRES).read_raw(
        lambda *_: True)
    np.testing.assert_allclose(next(raws).map_from_camera, shots[0].pose, atol=1e-9)


def test_models_in_pieces_and_turned_images(shots, tmp_path):
    folder = write_colmap(tmp_path / 'a', shots)
    other = write_colmap(tmp_path / 'b', shots[:1])
    shutil.move(other / 'sparse/0', folder / 'sparse/1')
    assert any('2 pieces' in note for note in read_folder(folder, METRES).notes)
    path = folder / 'images/walk' / shots[0].path.name
    cv2.imwrite(str(path), np.zeros((640, 480, 3), dtype=np.uint8))
    refuses(folder, '480x640 px.*EXIF')


def test_false_counts_cost_nothing(shots, tmp_path):
    folder = write_colmap(tmp_path, shots)
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
    (lambda v: v.update(depth_unit_scale_factor=-1), 'unit of depth is -1'),
    (lambda v: v.update(applied_scale=1e-300), 'm from the origin'),
    (lambda v: v.pop('frames'), 'lists no frames'),
    (lambda v: v.pop('fl_x'), 'no intrinsics'),
    (lambda v: v.update(camera_model='EQUIRECTANGULAR'), 'EQUIRECTANGULAR'),
    (lambda v: v['frames'][0].update(transform_matrix=[[1, 0], [0, 1]]), 'transform_matrix is'),
    (lambda v: v['frames'][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
     'it is a reflection'),
    (lambda v: v['frames'][0].update(transform_matrix=[[np.nan] * 4] * 4), 'of shape')])
def test_faults_of_transforms_json(edit, expected, shots, tmp_path):
    refuses(edited(write_nerf(tmp_path, shots), edit), expected)


MUTATIONS = st.lists(st.tuples(st.floats(0.0, 0.999), st.binary(max_size=12)), max_size=6)


@pytest.mark.parametrize('layout', [*WRITERS, 'text'])
def test_any_bytes_end_in_a_message(layout, shots, tmp_path_factory):
    folder = tmp_path_factory.mktemp('fuzz') / 'scan'
    if layout == 'text':
        write_colmap(folder, shots[:2], text=True)
    else:
        WRITERS[layout](folder, shots[:2])
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
