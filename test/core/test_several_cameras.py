# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one robot, which look in different directions at the same instant."""

from dataclasses import replace

import numpy as np
import pytest
from cameras import MAP, MOUNTS, NAMES, look
from scene import rigid
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer

OPTIONS = RelocalizerOptions(matching='class', tilt_deviation_deg=0.0)
STEP = rigid((0.3, 0.0, 0.2), 'y', 8.0)


def test_together_they_see_enough(rng):
    relocalizer = Relocalizer(MAP, OPTIONS)
    accepted = []
    for _ in range(6):
        *others, last = look(rng)
        alone = relocalizer.relocalize([last])
        found = Localizer(relocalizer).answer(Query((*others, last), run=None))
        accepted.append((alone.accepted, found.accepted))
        if found.accepted:
            assert pose_error(found.map_from_camera, MOUNTS[-1])[0] < 0.5
    alone, together = np.sum(accepted, axis=0)
    assert alone <= 3 < 5 <= together


def test_cameras_of_one_instant_have_no_odometry_between_them(rng, verified_camera):
    """Frames with equal names are from one camera that moved."""
    relocalizer = Relocalizer(MAP, replace(OPTIONS, mount_deviation=(0.0, 0.0)))
    frames = look(rng, objects=5)
    rigid, moving = (relocalizer.relocalize([replace(frame, camera_name=name) for frame, name in
                                             zip(frames, names, strict=True)])
                     for names in (NAMES, 4 * ('',)))
    assert np.trace(rigid.covariance) < 0.9 * np.trace(moving.covariance)


@pytest.mark.once
def test_the_covariance_holds_the_errors_of_mounts(rng):
    deviation = (0.03, 1.5)
    stated, ignored = (Relocalizer(MAP, replace(OPTIONS, mount_deviation=given))
                       for given in (deviation, (0.0, 0.0)))
    squares = []
    for _ in range(14):
        wrong = [mount @ make_transform(Rotation.from_rotvec(
            np.radians(deviation[1]) * rng.normal(size=3)).as_matrix(),
            deviation[0] * rng.normal(size=3)) for mount in MOUNTS[:-1]]
        frames = look(rng, objects=5, mounts=[*wrong, MOUNTS[-1]])
        found = [relocalizer.relocalize(frames) for relocalizer in (stated, ignored)]
        if all(pose_error(result.map_from_camera, MOUNTS[-1])[0] < 1.0 for result in found):
            squares.append([
                normalized_square(result.map_from_camera, result.covariance, MOUNTS[-1])
                for result in found])
    within = (np.array(squares) < chi2.ppf(0.95, 6)).mean(axis=0)
    print(f'\n{len(squares)} poses, in the 95 % ellipsoids: stated {within[0]:.2f}, ignored '
          f'{within[1]:.2f}')
    assert within[0] >= 0.9


def test_instants_are_kept_and_replaced_as_a_whole(rng):
    localizer = Localizer(Relocalizer(MAP, OPTIONS))

    def localize(number, pose):
        *others, last = look(rng, pose, stamp_ns=number)
        found = localizer.answer(Query((*others, last), limit=5, length_s=60.0))
        return found, [len(instant.searched) for instant in localizer._instants]
    assert localize(0, np.eye(4))[1] == [4]
    assert localize(1, np.eye(4))[1] == [4], 'a standing robot replaces its instant'
    assert localize(2, STEP)[1] == [4, 4]
    found, kept = localize(3, STEP @ STEP)
    assert kept == [4, 4]
    assert sum(kept) <= MAX_FRAMES
    assert pose_error(found.map_from_camera, STEP @ STEP @ MOUNTS[-1])[0] < 0.5


@pytest.mark.parametrize(('turned_deg', 'objects', 'wrong'), [
    (2.0, 5, []), (5.0, 5, ['left']), (60.0, 3, ['left'])])
def test_a_camera_that_contradicts_the_others_is_named(rng, turned_deg, objects, wrong):
    localizer, mounts = Localizer(Relocalizer(MAP, OPTIONS)), list(MOUNTS)
    mounts[1] = mounts[1] @ rigid(axis='y', degrees=turned_deg)
    for number in range(8):
        assert not localizer.cameras.wrong_mounts or number >= 5
        *others, last = look(rng, objects=objects, mounts=mounts)
        found = localizer.answer(Query((*others, last), run=None))
        assert found.accepted
        assert pose_error(found.map_from_camera, MOUNTS[-1])[0] < 0.3
    assert localizer.cameras.wrong_mounts == wrong


@pytest.mark.parametrize(('instants', 'objects', 'matched', 'others', 'wrong'), [
    (5, 4, 1, 4, ['left']), (4, 4, 1, 4, []), (5, 2, 0, 2, []), (5, 4, 2, 4, []),
    (5, 4, 1, 2, [])])
def test_a_mount_is_judged_by_what_the_other_cameras_match(rng, instants, objects, matched, others,
                                                           wrong):
    """Too few instants or objects, half of the objects matched, or other cameras miss half too."""
    check = CameraCheck()
    for _ in range(instants):
        check.add_instant(look(rng), [objects] * 4, [others, matched, others, others])
    assert check.wrong_mounts == wrong


def test_a_map_that_is_out_of_date_is_not_blamed_on_a_mount(rng):
    """All objects have swapped places. No pose is accepted, so no mount is judged."""
    exchanged = replace(MAP, centers=MAP.centers[np.random.default_rng(0).permutation(len(MAP))])
    localizer = Localizer(Relocalizer(exchanged, OPTIONS))
    for _ in range(10):
        *others, last = look(rng, objects=5)
        assert not localizer.answer(Query((*others, last), run=None)).accepted
    assert localizer.cameras.wrong_mounts == []
