# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the studies of keyframes: false accepts, and right poses over their probability."""

import numpy as np
from scene import CAMERA, MAP_FROM_CAMERA

from cliploc_ros.datasets.frames import Frame
from cliploc_ros.evaluation.keyframe_study.asking import Outcome, Row
from cliploc_ros.evaluation.keyframe_study.changes import elsewhere
from cliploc_ros.evaluation.keyframe_study.reliability import false_accepts, reliability


def row(case, error_m, accepted, chance):
    outcome = Outcome(error_m, accepted, 1.0, np.inf, chance)
    return Row(case, 0, {'both': outcome, 'landmarks': outcome},
               {'chance': chance, 'error_m': error_m})


ROWS = [row('here', 0.1, True, 0.995), row('here', 0.2, True, 0.992), row('here', 3.0, False, 0.3),
        row('other room', np.inf, True, 0.98), row('other room', np.inf, False, 0.05),
        Row('other room', 5, dict.fromkeys(('both', 'landmarks'),
                                           Outcome(np.inf, False, 1.0, np.inf)), {})]


def test_an_accepted_pose_of_another_room_is_false():
    lines = {tuple(line[:56].split()): line[56:].split() for line in false_accepts(ROWS)}
    assert lines[('here', 'both')][:3] == ['3', '2', '0']
    assert lines[('other', 'room', 'both')][:3] == ['3', '1', '1']
    assert lines[('all', 'both')][:3] == ['6', '3', '1']
    assert float(lines[('all', 'both')][3]) < 1 / 6 < float(lines[('all', 'both')][5])


def test_right_poses_are_counted_by_probability():
    lines = [line[22:].split() for line in reliability(ROWS) if line.startswith('the keyframes')]
    assert [(one[0], one[2], one[4]) for one in lines] == [
        ('0.01', '1', '0.000'), ('0.10', '1', '0.000'), ('0.97', '1', '0.000'),
        ('0.99', '2', '1.000')]
    assert lines[-1][3] == '0.994'


def test_a_poster_shows_a_place_that_looks_another_way():
    rng = np.random.default_rng(0)
    turned = [MAP_FROM_CAMERA @ np.diag([sign, 1.0, sign, 1.0]) for sign in (1.0, -1.0)]
    frames = [Frame(number, np.zeros((4, 4, 3), np.uint8), CAMERA, pose)
              for number, pose in enumerate([*turned, MAP_FROM_CAMERA])]
    assert elsewhere(frames[0], frames[1:], rng) is frames[1]
    assert elsewhere(frames[0], [frames[2]], rng) is frames[2], 'there is none'
