# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of other systems: what is read, left out and refused."""

import json

import foreign_maps as written
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.given_map import place, read_table
from studies.foreign_maps import COCO, main, read_goreloc, read_msgloc, read_oaslam

HERE = ('map', 1.0, np.eye(4))
CUP = COCO.index('cup')
SPHERE = written.dual_quadric([1, 2, 3], [0.1, 0.2, 0.3], [0, 0, 0, 1])


@pytest.fixture
def true_map():
    rng = np.random.default_rng(5)
    names = ('cup', 'book', 'chair', 'cup')
    return LandmarkMap('map', ('a', 'b', 'c', 'd'), ('a red cup', 'b', 'c', 'd'), names,
                       rng.uniform(-3, 3, (4, 3)), rng.uniform(0.03, 0.6, (4, 3)),
                       Rotation.random(4, random_state=5).as_quat())


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def shapes(landmark_map):
    axes = (Rotation.from_quat(landmark_map.quats_xyzw).as_matrix()
            * landmark_map.semi_axes[:, None, :])
    return axes @ axes.transpose(0, 2, 1)


def import_all(given, placement=HERE):
    return place(given, 'a test', *placement)


VASE = (('book', 0.75), ('vase', 0.25))


@pytest.mark.parametrize(('read', 'name', 'content', 'weights', 'support', 'note'), [
    (read_goreloc, 'm.objects', written.goreloc_file, VASE, None, ''),
    (read_oaslam, 'm.txt', written.oaslam_text, None, None, 'a monocular map of OA-SLAM'),
    (read_oaslam, 'map_m.mapobjects', lambda given: written.oaslam_files(given)[0], None, 4,
     'a monocular map'),
    # quaternions are w, x, y, z; signs of radii mean nothing; shares are not likelihoods
    (read_msgloc, 'm.json', written.msgloc_text, VASE, None, '4 landmarks')])
def test_maps_of_other_systems(true_map, tmp_path, read, name, content, weights, support, note):
    path = write(tmp_path / name, content(true_map))
    if support:
        with pytest.raises(DatasetError, match='objecttracks'):
            read(path, COCO)
        write(path.with_suffix('.objecttracks'), written.oaslam_files(true_map)[1])
    given = read(path, COCO)
    found, left_out = import_all(given)
    assert left_out == [] and ''.join(given.notes).startswith(note)
    assert found.landmark_ids == ('cup_0', 'book_1', 'chair_2', 'cup_3')
    assert found.class_ids == true_map.class_ids
    np.testing.assert_allclose(found.centers, true_map.centers, atol=1e-5)
    np.testing.assert_allclose(shapes(found), shapes(true_map), atol=1e-5)
    detail = found.details[1]
    assert (detail.source, detail.class_weights, detail.support) == ('a test', weights, support)


@pytest.mark.parametrize('encoding', ['utf-8-sig', 'utf-16'])
def test_table_of_a_spreadsheet(tmp_path, encoding):
    """Semicolons, decimal commas, a byte order mark, another order, empty rows and cells."""
    text = ('class_id;c;b;a;z;y;x;label;colour;support\r\n'
            'cup;0,1;0,2;0,3;1,5;-2;3;Tasse, groß;rot;7\r\n'
            ';;;;;;;;;\r\n'
            '"book";0.1;0.1;0.1;0;0;0;;;;\r\n')
    given = read_table(write(tmp_path / 'm.csv', text.encode(encoding)))
    found, _ = import_all(given)
    assert found.labels == ('Tasse, groß', 'book')
    assert found.landmark_ids == ('cup_1', 'book_2')
    assert found.centers[0].tolist() == [3.0, -2.0, 1.5]
    assert found.semi_axes[0].tolist() == [0.3, 0.2, 0.1]
    assert found.quats_xyzw[0].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert [detail.support for detail in found.details] == [7, None]
    assert [note.endswith(' colour') for note in given.notes] == [True]


def test_scale_and_transform(true_map, tmp_path):
    turn = Rotation.from_euler('xyz', [0.3, -1.0, 2.0])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), [5.0, 6.0, 7.0]
    path = write(tmp_path / 'm.csv', written.table_text(true_map))
    given = read_table(path)
    given.landmarks[0] = given.landmarks[0]._replace(details=LandmarkDetails(position_sigma=0.2))
    found, _ = import_all(given, ('world', 2.0, pose))
    assert found.frame_id == 'world' and found.details[0].position_sigma == 0.4
    np.testing.assert_allclose(
        found.centers, turn.apply(2.0 * true_map.centers) + pose[:3, 3], atol=1e-9)
    matrix = turn.as_matrix()
    np.testing.assert_allclose(shapes(found), 4.0 * matrix @ shapes(true_map) @ matrix.T,
                               atol=1e-9)


@pytest.mark.parametrize(('read', 'content', 'message'), [
    (read_msgloc, b'[' * 100_000, 'is not JSON'),
    (read_goreloc, written.goreloc_object(0, SPHERE, [(CUP, 1)])[:-1], r'byte \d+'),
    (read_goreloc, b'\x0a' + written.varint(2**60), f'{2**60} bytes'),
    (read_oaslam, b'1 41 0.1 0.2', 'line 1: expected')])
def test_broken_files_are_refused(tmp_path, read, content, message):
    path = write(tmp_path / 'broken', content)
    with pytest.raises(DatasetError, match=message) as error:
        read(path, COCO)
    assert str(error.value).startswith(str(path))


def test_what_is_no_ellipsoid_is_left_out_with_the_reason(tmp_path):
    quadrics = [(np.diag([0.04, -0.04, 0.01, -1.0]), 'not an ellipsoid: squared semi-axes'),
                (SPHERE * np.nan, 'not finite'), (SPHERE.ravel()[:9], 'has 9 numbers, not 16')]
    path = write(tmp_path / 'm.objects', b''.join(
        written.goreloc_object(row, quadric, [(CUP, 1)])
        for row, quadric in enumerate([*(one for one, _ in quadrics), SPHERE])))
    found, left_out = import_all(read_goreloc(path, COCO))
    assert found.landmark_ids == ('cup_3',)
    for (_, reason), (_, told) in zip(quadrics, left_out, strict=True):
        assert reason in told


def test_a_map_of_msgloc_as_published(shared_data, tmp_path):
    samples, out = shared_data / 'import_samples', tmp_path / 'm.yaml'
    assert main(list(map(str, [
        samples / 'msgloc_walk_yolo_coco_map.json', '--from', 'msgloc', '--class-names',
        samples / 'msgloc_coco.txt', '--out', out, '--report', tmp_path / 'm.json']))) == 0
    found = LandmarkMap.from_file(out)
    left_out = json.loads((tmp_path / 'm.json').read_text())['left_out']
    assert len(found) == 116 and len(left_out) == 16
    assert all('semi-axes are' in entry['reason'] for entry in left_out)
    row = found.landmark_ids.index('wine_glass_0')
    np.testing.assert_allclose(found.centers[row], [2.07811, 0.40396, -0.48006], atol=1e-4)
    assert found.details[row].class_weights == (('wine glass', 0.9916), ('cup', 0.0084))
