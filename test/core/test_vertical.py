# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A known vertical and a known height: what they buy, and what a wrong one does."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, see_room
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError

LIMITS_M = (0.25, 0.5, 1.0)
HEIGHTS = (0.8, 2.2)
UP_IN_CAMERA = MAP_FROM_CAMERA[2, :3]
LEVEL = np.s_[3:5, 3:5]  # of a covariance: turns about level axes


def with_vertical(room, up=UP_IN_CAMERA):
    return Observation(CAMERA, see_room(room), None, up_in_camera=up)


def turned(up, error_deg, rng):
    """The vertical, turned by a normally distributed angle about a level axis."""
    axis = rng.normal(size=3)
    axis -= axis @ up * up
    angle = np.radians(error_deg) * rng.normal()
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).apply(up)


def errors_m(landmark_map, frames, observe, options, error_deg=None, seed=0):
    """How far each frame's pose is from the truth, infinite where there is none; and belief."""
    relocalizer, rng = Relocalizer(landmark_map, options), np.random.default_rng(seed)
    errors, accepted = [], []
    for frame in frames:
        observation = observe(frame)
        if error_deg is not None:
            up = turned(frame.map_from_camera[2, :3], error_deg, rng)
            observation = replace(observation, up_in_camera=up)
        found = relocalizer.relocalize([observation])
        errors.append(pose_error(found.map_from_camera, frame.map_from_camera)[0]
                      if found.solved else math.inf)
        accepted.append(found.accepted)
    return np.array(errors), np.array(accepted)


@pytest.mark.full
@pytest.mark.parametrize('case', ['nothing', 'height', 'vertical_0_deg', 'vertical_1_deg',
                                  'vertical_3_deg'])
def test_success_with_what_is_known(case, office_map, queries, observe, thresholds):
    least = thresholds['known'][case]
    options = RelocalizerOptions(height_range_m=(-math.inf, math.inf) if case == 'nothing'
                                 else HEIGHTS)
    error_deg = float(case.split('_')[1]) if case.startswith('vertical') else None
    seeds = range(3) if error_deg else (0,)
    found = [errors_m(office_map, queries.main_frames(), observe, options, error_deg, seed)
             for seed in seeds]
    errors = np.concatenate([errors for errors, _ in found])
    accepted = np.concatenate([accepted for _, accepted in found])
    rates = [np.mean(errors < limit) for limit in LIMITS_M]
    median = np.median(errors[np.isfinite(errors)])
    print(f'\nknown {case}: success {" / ".join(f"{rate:.3f}" for rate in rates)} at '
          f'0.25 / 0.5 / 1 m, median of the solved {median:.3f} m, '
          f'{np.mean(accepted):.2f} accepted, {np.sum(accepted & (errors > 1.0))} of them wrong')
    assert (np.array(rates) >= least['success']).all()
    assert median <= least['median_m']
    assert not (accepted & (errors > 1.0)).any()


@pytest.mark.parametrize('tilt_deg', [
    90.0, 180.0])
def test_a_vertical_that_is_wrong_misleads_nobody(tilt_deg, office_map, queries, observe):
    """As by a wrong mount: what boxes say without it is among the rivals."""
    relocalizer, rng = Relocalizer(office_map, RelocalizerOptions()), np.random.default_rng(0)
    accepted, wrong = 0, 0
    for frame in queries.main_frames():
        up = frame.map_from_camera[2, :3]
        axis = np.cross(up, rng.normal(size=3))
        up = Rotation.from_rotvec(np.radians(tilt_deg) * axis / np.linalg.norm(axis)).apply(up)
        found = relocalizer.relocalize([replace(observe(frame), up_in_camera=up)])
        if found.accepted:
            accepted += 1
            wrong += pose_error(found.map_from_camera, frame.map_from_camera)[0] > 1.0
    print(f'\nvertical off by {tilt_deg:g} deg: {accepted} of 52 accepted, {wrong} wrong')
    assert wrong == 0


def test_two_objects_and_the_vertical_fix_a_pose(room):
    """But are refused, for four are asked; and without a vertical there is none."""
    options = RelocalizerOptions(matching='class')
    pair = np.array([0, 1])
    observation = with_vertical(room)
    observation = replace(observation, detections=observation.detections.select(pair))
    found = Relocalizer(room, options).relocalize([observation])
    assert found.solved and not found.accepted
    assert len(found.matches) == 2
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    blind = Relocalizer(room, options).relocalize([replace(observation, up_in_camera=None)])
    assert not blind.solved
    assert 'fewer than 3' in blind.reason


def test_a_vertical_makes_a_pose_surer(room):
    relocalizer = Relocalizer(room, RelocalizerOptions(matching='class'))
    upright = relocalizer.relocalize([with_vertical(room)])
    free = relocalizer.relocalize([with_vertical(room, None)])
    for found in (upright, free):
        assert pose_error(found.map_from_camera, MAP_FROM_CAMERA)[0] < 1e-2
    assert np.trace(upright.covariance[LEVEL]) < np.trace(free.covariance[LEVEL])


def test_a_height_that_is_wrong_leaves_no_pose_outside(room):
    truth = MAP_FROM_CAMERA[2, 3]
    inside = RelocalizerOptions(matching='class', height_range_m=(truth - 0.1, truth + 0.1))
    assert Relocalizer(room, inside).relocalize([with_vertical(room, None)]).accepted
    outside = replace(inside, height_range_m=(truth + 1.0, truth + 2.0), refine=False)
    for hypothesis in Relocalizer(room, outside).relocalize(
            [with_vertical(room, None)]).hypotheses:
        assert truth + 1.0 <= hypothesis.map_from_camera[2, 3] <= truth + 2.0


def test_the_papers_algorithms_ask_for_no_vertical(room):
    """Where the paper's own configuration is asked for, exactly that runs."""
    paper = RelocalizerOptions(matching='class', algorithm='bf', refine=False)
    found = [Relocalizer(room, paper).relocalize([with_vertical(room, up)])
             for up in (UP_IN_CAMERA, None)]
    assert found[0].tried == found[1].tried
    assert np.array_equal(found[0].map_from_camera, found[1].map_from_camera)


@pytest.mark.parametrize('up', [np.zeros(3), np.full(3, np.nan), np.array([0, -2.0, 0]),
                                np.array([1.0, 0.0])])
def test_a_vertical_is_a_unit_vector(room, up):
    with pytest.raises(OptionsError, match='up_in_camera'):
        Relocalizer(room, RelocalizerOptions(matching='class')).relocalize(
            [with_vertical(room, up)])


@pytest.mark.parametrize('heights', [(2.0, 1.0), (1.0, 1.0), (math.nan, 2.0), (1.0,)])
def test_a_height_range_has_two_ends(heights):
    with pytest.raises(OptionsError, match='height_range_m'):
        RelocalizerOptions(height_range_m=heights)
