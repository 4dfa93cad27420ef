# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Priors (a region, a vertical, a height): their benefit, and the effect of wrong ones."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene import BY_CLASS, MAP_FROM_CAMERA, ROOM, doubled_room, level, observe
from scipy.spatial.transform import Rotation
from test_map_file import floor, join

from cliploc_ros.core.acceptance.confidence import confidences, region_odds
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Region
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError

TERMS = CALIBRATION.prior
TWINS = doubled_room(np.array([10.0, 0.0, 0.0]))
LACKING = TWINS.select(range(21))
ANY_YAW = 100.0


def region(x=0.0, y=0.0, sigma_m=0.5, probability=0.95, frame_id='map', yaw=0.0,
           yaw_deviation=ANY_YAW):
    return Region(frame_id, np.array([x, y, yaw]),
                  np.diag([sigma_m, sigma_m, yaw_deviation]) ** 2, probability)


def ask(landmark_map=TWINS, objects=12, options=BY_CLASS, **known):
    return Relocalizer(landmark_map, options).relocalize(
        [observe(ROOM, rows=range(objects), **known)])


def looking(yaw, x=0.0, y=0.0):
    """Return a level camera pose."""
    return level(x, y, math.degrees(yaw), 0.0)[None]


SURE, AHEAD = region(sigma_m=1e-6, probability=1.0), region(yaw=math.pi - 0.05, yaw_deviation=0.1)


@pytest.mark.parametrize(('known', 'pose', 'odds'), [
    # the mixture: 85.73 m2 of the map times the density at 4 m, exp(-8 / 9.09) / (2 pi 9.09 m2)
    (region(probability=0.5, sigma_m=3.0), looking(0.0, 4.0), math.log(0.5 + 0.5 * 0.6225)),
    (region(probability=0.5), looking(0.0, 9.0), math.log(0.5)),
    # never surer than its limits
    (SURE, looking(0.0), 0.0), (SURE, looking(0.0, 9.0), -TERMS.most),
    # a region that says nothing
    (region(5.0, sigma_m=1e4), looking(0.0), 0.0), (region(probability=0.0), looking(0.0, 3.0), 0),
    (region(frame_id='elsewhere'), looking(0.0, 3.0), 0.0),
    # the yaw counts across the seam, and a camera that looks up has none
    (AHEAD, looking(0.05 - math.pi), 0.0), (AHEAD, looking(0.0), -TERMS.most),
    (region(yaw=2.0, yaw_deviation=0.01), np.eye(4)[None], 0.0)])
def test_the_odds_of_a_pose_given_a_region(known, pose, odds):
    assert region_odds(TWINS, known, pose) == pytest.approx([odds], abs=1e-3)


@pytest.mark.parametrize('fields', [{'x': np.nan}, {'sigma_m': 0.0}, {'sigma_m': np.inf},
                                    {'probability': 1.5}, {'yaw_deviation': np.nan}])
def test_what_is_no_region_is_refused(fields):
    with pytest.raises(OptionsError, match=r'region: |covariance of x, y and yaw'):
        region(**fields)


def test_a_region_decides_between_rooms_that_nearly_look_the_same():
    """The second room lacks three objects: more than expected by chance, but not conclusive."""
    alone = ask(LACKING)
    assert alone.refusal_kind == 'look_alike'
    found = ask(LACKING, region=region())
    assert found.accepted, found.reason
    assert pose_error(found.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05
    assert not ask(LACKING, region=region(probability=0.3)).accepted
    wrong = ask(LACKING, region=region(10.0, probability=1.0))
    assert not wrong.accepted and wrong.confidence < alone.confidence


def test_no_region_decides_alone_between_identical_rooms():
    for x_m in (0.0, 10.0):
        found = ask(region=region(x_m, probability=1.0))
        assert found.refusal_kind == 'look_alike'
        assert found.map_from_camera[0, 3] == pytest.approx(x_m + 0.3, abs=0.05)
        assert ask().confidence < found.confidence < 0.8


def test_a_region_of_another_floor_decides_between_equal_floors():
    floors = join(floor('floor_1'), floor('floor_2'))
    seen = observe(floor(''))
    for row, name in enumerate(('floor_1', 'floor_2')):
        found = Relocalizer(floors, BY_CLASS).relocalize(
            [replace(seen, region=region(frame_id=name))])
        assert (found.map_from_camera[0, 3] > 1e3) == bool(row)


def test_a_confident_wrong_region_accepts_nothing_and_is_named():
    wrong = region(5.0, probability=1.0)
    assert not ask(region=wrong).accepted, 'neither room is recognized'
    refused = ask(ROOM, 3, region=wrong)
    assert refused.confidence < ask(ROOM, 3).confidence
    assert 'prior' in refused.reason
    sure = ask(ROOM, region=wrong)
    assert sure.accepted and pose_error(sure.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05


@given(st.lists(st.tuples(st.floats(-5, 9), st.floats(-3, 0)), min_size=1, max_size=5))
def test_no_prior_gives_more_than_the_objects_give_without_rivals(contenders):
    odds, prior = np.array(contenders).T
    poses = np.array([level(5.0 * row) for row in range(len(odds))])
    told = confidences(odds, poses, 2.0, prior=prior)
    alone = [confidences(odds[[row]], poses[[row]], 2.0)[0] for row in range(len(odds))]
    assert (told <= np.array(alone) + 1e-9).all() and told.sum() <= 1.0 + 1e-9


UP_IN_CAMERA = MAP_FROM_CAMERA[2, :3]


def with_vertical(room, up=UP_IN_CAMERA, rows=None):
    return observe(room, rows=rows, up_in_camera=up)


@pytest.mark.once
@pytest.mark.parametrize('tilt_deg', [90.0, 180.0])
def test_a_vertical_that_is_wrong_misleads_nobody(tilt_deg, office_map, queries, observed):
    """As with a wrong mount: the pose from boxes without the vertical is among the rivals."""
    relocalizer, rng = Relocalizer(office_map, RelocalizerOptions()), np.random.default_rng(0)
    accepted, wrong = 0, 0
    for frame in (frame for frame in queries.frames if frame.is_main):
        up = frame.map_from_camera[2, :3]
        axis = np.cross(up, rng.normal(size=3))
        up = Rotation.from_rotvec(np.radians(tilt_deg) * axis / np.linalg.norm(axis)).apply(up)
        found = relocalizer.relocalize([replace(observed(frame), up_in_camera=up)])
        if found.accepted:
            accepted += 1
            wrong += pose_error(found.map_from_camera, frame.map_from_camera)[0] > 1.0
    print(f'\nvertical off by {tilt_deg:g} deg: {accepted} of 52 accepted, {wrong} wrong')
    assert wrong == 0


def test_the_right_pose_is_the_rival_of_one_by_a_wrong_vertical(room):
    up = Rotation.from_euler('x', 45, degrees=True).apply(UP_IN_CAMERA)
    found = Relocalizer(room, BY_CLASS).relocalize([with_vertical(room, up)])
    assert not found.accepted
    assert found.evidence.rival.place == pytest.approx(MAP_FROM_CAMERA[:3, 3], abs=0.05)


def test_two_objects_and_the_vertical_fix_a_pose(room):
    """The pose is refused, since four objects are required; without a vertical there is none."""
    relocalizer = Relocalizer(room, BY_CLASS)
    found = relocalizer.relocalize([with_vertical(room, rows=[0, 1])])
    assert found.solved and not found.accepted
    assert len(found.matches) == 2
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    blind = relocalizer.relocalize([with_vertical(room, None, [0, 1])])
    assert not blind.solved
    assert 'fewer than 3' in blind.reason


def test_a_height_that_is_wrong_leaves_no_pose_outside(room):
    truth = MAP_FROM_CAMERA[2, 3]
    inside = RelocalizerOptions(matching='class', height_range_m=(truth - 0.1, truth + 0.1))
    assert Relocalizer(room, inside).relocalize([with_vertical(room, None)]).accepted
    outside = replace(inside, height_range_m=(truth + 1.0, truth + 2.0), refine=False)
    for hypothesis in Relocalizer(room, outside).relocalize(
            [with_vertical(room, None)]).hypotheses:
        assert truth + 1.0 <= hypothesis.map_from_camera[2, 3] <= truth + 2.0


def test_the_papers_algorithms_ask_for_no_vertical(room):
    """If the paper's configuration is requested, exactly that configuration runs."""
    paper = RelocalizerOptions(matching='class', algorithm='bf', refine=False)
    found = [Relocalizer(room, paper).relocalize([with_vertical(room, up)])
             for up in (UP_IN_CAMERA, None)]
    assert found[0].tried == found[1].tried
    assert np.array_equal(found[0].map_from_camera, found[1].map_from_camera)


@pytest.mark.parametrize('up', [np.zeros(3), np.full(3, np.nan), np.array([0, -2.0, 0]),
                                np.array([1.0, 0.0])])
def test_a_vertical_is_a_unit_vector(room, up):
    with pytest.raises(OptionsError, match='up_in_camera'):
        Relocalizer(room, BY_CLASS).relocalize([with_vertical(room, up)])

