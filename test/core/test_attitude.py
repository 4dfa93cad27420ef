# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What tilt and uncertainty of a pose take from its confidence, and which hypothesis leads."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    confidences,
    none_right,
    tilt_handicaps,
    utilities,
)
from cliploc_ros.core.acceptance.verdict import Evidence, refusal
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer

WRONG_MOUNT = CALIBRATION.attitude.wrong_mount
# Optical axes of a level camera that looks along the map's x axis: right, down, forward.
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def turned(axis, degrees):
    """Poses (m, 4, 4) of a level camera, turned about an axis of its own."""
    poses = np.tile(np.eye(4), (len(degrees), 1, 1))
    poses[:, :3, :3] = LEVEL @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return poses


@pytest.mark.parametrize('axis', ['x', 'z'])
def test_the_more_a_camera_is_tilted_the_more_speaks_against_it(axis):
    against = tilt_handicaps(turned(axis, np.arange(0, 181, 15)[:, None]), 40.0)
    assert (np.diff(against) >= 0.0).all()
    # handheld and downward cameras lose nothing, cameras upside down all
    assert (against[:5] == 0.0).all()
    assert 0.0 < against[6] < 2.0
    assert against[-1] == WRONG_MOUNT


def test_the_heading_does_not_matter_nor_a_deviation_of_zero():
    assert (tilt_handicaps(turned('y', np.arange(0, 360, 30)[:, None]), 40.0) == 0.0).all()
    assert (tilt_handicaps(turned('z', np.arange(0, 181, 15)[:, None]), 0.0) == 0.0).all()


def test_a_handicap_takes_confidence_and_gives_it_to_the_rival():
    odds, poses = utilities([Support(4, 2.5, 6.0, 8.0, 6.0)] * 2), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 5.0
    none = none_right(Setting(40))
    level = confidences(odds, poses, none)
    upside_down = confidences(odds - [WRONG_MOUNT, 0.0], poses, none)
    assert level[0] == pytest.approx(level[1])
    assert upside_down[0] < 0.02 < level[1] < upside_down[1]


@pytest.mark.parametrize('deviations_m', [(0.3, 0.3, 0.3), (0.5, 0.1, 0.02), (2.0, 1.0, 0.1),
                                          (0.4, 0.4, 0.01)])
def test_the_share_within_a_distance_is_that_of_drawn_positions(deviations_m, rng):
    turn = Rotation.random(random_state=1).as_matrix()
    covariance = np.eye(6)
    covariance[:3, :3] = turn @ np.diag(np.square(deviations_m)) @ turn.T
    drawn = rng.normal(size=(200_000, 3)) * deviations_m
    share = (np.linalg.norm(drawn, axis=1) < 1.0).mean()
    assert share_within(1.0, covariance) == pytest.approx(share, abs=0.04)


def test_a_pose_of_uncertain_position_is_refused_and_says_so():
    certain = Evidence(5, 0.9999, near=0.9999, deviation_m=0.1)
    vague = replace(certain, near=0.95, deviation_m=0.514)
    options = RelocalizerOptions(min_confidence=0.99)
    assert refusal(certain, options) is None
    assert vague.confidence == pytest.approx(0.9499, abs=1e-4)
    assert 'uncertain by 0.51 m' in refusal(vague, options).reason


def test_the_likeliest_hypothesis_leads_and_without_refinement_the_greatest_score(
        office_map, queries, observe):
    likeliest = Relocalizer(office_map, RelocalizerOptions(tilt_deviation_deg=0.0))
    greatest = Relocalizer(office_map, RelocalizerOptions(refine=False))
    differ = 0
    for frame in list(queries.main_frames())[:20]:
        found = likeliest.relocalize([observe(frame)]).hypotheses
        worth = utilities([one.support for one in found])
        assert (np.diff(worth) <= 0.0).all()
        scores = [one.score for one in found]
        differ += scores != sorted(scores, reverse=True)
        scores = [one.score for one in greatest.relocalize([observe(frame)]).hypotheses]
        assert scores == sorted(scores, reverse=True)
    assert differ > 0
