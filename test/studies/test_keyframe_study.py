# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The study of keyframes: its pictures and worlds are exact, its records complete."""

import json
import pickle
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from scene import CAMERA, make_room

from cliploc_ros.core.geometry.ellipsoid import shape_matrices
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from studies.keyframes.cases import (
    World,
    hang,
    make_picture,
    mirrored_map,
    moved_half,
    twin,
)
from studies.keyframes.fit import Row, chance, fit, left_out, report
from studies.keyframes.judge import Outcome, table

pytestmark = pytest.mark.full

RNG = partial(np.random.default_rng, 1)
BLACK = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
# Brighter from left to right in red, from top to bottom in green.
ROWS, COLUMNS = np.mgrid[:CAMERA.height, :CAMERA.width]
SOURCE = np.stack([40 + COLUMNS / 4, 40 + ROWS / 4, 0 * ROWS], axis=-1).astype(np.uint8)


def picture(kind, share=0.3):
    return make_picture(kind, share, CAMERA, SOURCE, CAMERA, RNG())


@pytest.mark.parametrize('kind', ['crop', 'shrunk', 'warped'])
@pytest.mark.parametrize('share', [0.15, 0.6])
def test_a_picture_takes_its_share(kind, share):
    shown = hang(BLACK, picture(kind, share), CAMERA, np.eye(4)).any(axis=-1)
    assert abs(shown.mean() - share) < 0.02


def test_a_crop_is_like_a_window():
    shown = hang(BLACK, picture('crop'), CAMERA, np.eye(4))
    inside = shown.any(axis=-1)
    assert np.abs(shown[inside].astype(int) - SOURCE[inside]).max() <= 1


def test_a_second_look_sees_the_same_plane():
    it, aside = picture('warped'), make_transform(np.eye(3), np.array([0.2, 0.05, 0.0]))
    shown = hang(BLACK, it, CAMERA, aside)
    for across in ((0.2, 0.3), (0.5, 0.5), (0.7, 0.6)):
        point = it.corner + across[0] * it.right + across[1] * it.down - aside[:3, 3]
        column, row = np.round(CAMERA.project_normalized(point[:2] / point[2])[0]).astype(int)
        expected = [40 + across[0] * CAMERA.width / 4, 40 + across[1] * CAMERA.height / 4]
        assert np.abs(shown[row, column, :2] - expected).max() < 4


@pytest.fixture
def world():
    """A room with two keyframes that show the same points."""
    points = np.random.default_rng(0).uniform((-2, -2, 3), (2, 2, 6), (40, 3))
    poses = np.stack([np.eye(4), make_transform(np.eye(3), np.array([0.5, 0.0, 0.0]))])
    inside = np.concatenate([points - pose[:3, 3] for pose in poses]).astype(np.float32)
    rows = np.arange(80)
    layer = KeyframeLayer(
        'map', (), np.empty((0, 3), np.float32), CAMERA, poses, np.array([0, 40, 80]),
        np.column_stack([rows, rows]).astype(np.uint16), inside,
        np.tile(rows[:, None], 128).astype(np.uint8), rows.astype(np.uint16),
        np.zeros((1, 128), np.uint8))
    return World(make_room(), layer, np.zeros(3))


def test_one_half_moves_with_its_landmarks_and_points(world):
    changed = moved_half(1.5, world, RNG())
    assert np.linalg.norm(changed.shift_m) == pytest.approx(1.5)
    assert changed.shift_m[2] == 0.0
    steps = [changed.landmark_map.centers - world.landmark_map.centers,
             *(changed.layer.points_in_map(row) - world.layer.points_in_map(row)
               for row in (0, 1))]
    for step in steps:
        moved = np.linalg.norm(step, axis=1) > 0.1
        assert 0 < moved.sum() < len(step)
        assert np.allclose(step[moved], changed.shift_m, atol=1e-5)
        assert np.allclose(step[~moved], 0.0, atol=1e-5)
    assert np.allclose(steps[1], steps[2], atol=1e-5), 'both keyframes show the same room'


def test_a_twin_has_its_share_of_keyframes(world):
    for share, keyframes in ((0.0, 2), (0.5, 3), (1.0, 4)):
        changed = twin(share, 3, world, RNG())
        assert len(changed.layer) == keyframes
        assert len(changed.landmark_map) == 2 * 12 - 3
        for row in range(2, keyframes):
            assert np.allclose(changed.layer.points_in_map(row) - changed.shift_m,
                               world.layer.points_in_map(row - 2), atol=1e-5)
            assert (changed.layer.unit_descriptors(row)
                    == world.layer.unit_descriptors(row - 2)).all()


def test_landmarks_are_mirrored_with_their_shapes(world):
    before, after = world.landmark_map, mirrored_map(world, RNG()).landmark_map
    middle = before.centers.mean(axis=0)
    mirror = np.linalg.lstsq(before.centers - middle, after.centers - middle, rcond=None)[0]
    assert np.linalg.det(mirror) == pytest.approx(-1.0)
    rows = [0, 1, 2, 1, 3, 4, 2, 4, 5]
    for its, others in zip(*(shape_matrices(one.semi_axes, one.quats_xyzw)[:, rows]
                             .reshape(-1, 3, 3) for one in (before, after)), strict=True):
        assert np.allclose(mirror.T @ its @ mirror, others)


def outcome(errors_m, accepted, refusal=''):
    return Outcome('site', 'site/part', 'family', 'family: case', 0, 'both', errors_m, accepted,
                   0.9, 1.0 if np.isfinite(errors_m[0]) else np.inf, refusal, '', 'both')


def test_an_accepted_pose_that_is_wrong_or_of_another_site_is_false():
    lines = table([outcome((0.05,), True), outcome((1.5,), True), outcome((np.inf,), True),
                   outcome((0.3,), False, 'ambiguous')], ['case'])
    assert lines[1].split()[2:] == ['both', '4', '0.25', '0.25', '0.50', '0.50', '3', '0.50',
                                    '1.00', '2', '0.150', 'to', '0.850', '1', 'ambiguous']


def test_a_moved_half_may_be_meant_as_well():
    unmoved, moved = table([outcome((1.5, 0.05), True)], ['family'])[1:]
    assert unmoved.split()[-4] == '1'
    assert moved.startswith('family (by the moved half)')
    assert moved.split()[-4] == '0'


def run(*arguments):
    done = subprocess.run([sys.executable, '-m', 'studies.keyframes', *map(str, arguments)],
                          capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_is_collected_is_judged(shared_data, tmp_path):
    """Two real sites; a second run asks only what is new."""
    kitchen = tmp_path / 'kitchen'
    kitchen.mkdir()
    for number in range(0, 200, 10):
        for path in (shared_data / 'seven_scenes_kitchen').glob(f'frame-{number:06}.*'):
            (kitchen / path.name).symlink_to(path)
    out, families = tmp_path / 'out', ('plain', 'picture pair elsewhere', 'twins, layer half')
    collect = ('collect', '--out', out, '--sites', kitchen, shared_data / 'tum_fr3_office',
               '--model', shared_data / 'weights' / 'yolov8n_coco.pt', '--places',
               'kitchen/interleaved', '--queries')
    run(*collect, 1, '--families', *families[:1])
    before = {path: path.read_bytes() for path in out.rglob('plain*')}
    run(*collect, 2, '--families', *families)
    assert {path: path.read_bytes() for path in before} == before
    stored = [pickle.loads(path.read_bytes()) for path in out.glob('cases/*/*')]
    numbers = {case.name: len(case.records) for case in stored}
    assert numbers['plain: one image'] == 10
    assert {count for name, count in numbers.items() if name.startswith('twins')} == {2}
    assert all(len(record.looks) == 2 and not record.truths for case in stored
               if case.name.startswith('picture pair') for record in case.records)
    figure = tmp_path / 'reliability.png'
    lines = run('judge', '--out', out, '--by', 'family', '--figure', figure,
                '--json', tmp_path / 'outcomes.json').splitlines()
    assert len([line for line in lines if line]) == 1 + 3 * len(families)
    assert figure.stat().st_size > 10_000
    outcomes = json.loads((tmp_path / 'outcomes.json').read_text())
    errors = [one['errors_m'][0] for one in outcomes
              if one['case'] == 'plain: one image' and one['way'] == 'keyframes']
    assert len(errors) == 10
    assert np.median(errors) < 0.1


def test_a_fit_finds_what_the_rows_were_made_from():
    rng, made_from = np.random.default_rng(0), np.array([1.0, 2.0, -3.0])
    rows = []
    for number in range(6000):
        predictors = np.array([1.0, *rng.normal(size=2)])
        ceiling = rng.uniform(0.5, 1.0)
        is_right = bool(rng.random() < ceiling * chance(predictors, made_from))
        rows.append(Row(f'site {number % 3}', 'picture', 'any', predictors, ceiling, is_right))
    np.testing.assert_allclose(fit(rows), made_from, rtol=0.1, atol=0.2)
    chances, right = left_out(rows), np.array([one.is_right for one in rows])
    for low in (0.1, 0.4, 0.7):
        its = (chances >= low) & (chances < low + 0.2)
        assert right[its].mean() == pytest.approx(chances[its].mean(), abs=0.06)
    line, = report(rows, chances)
    assert line.startswith('any ')
