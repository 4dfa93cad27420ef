# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detections that are of no use are named, by frame and over frames."""

import numpy as np
import pytest
from scene import CAMERA, make_room, see_room

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.relocalizer import Relocalization

NOTHING_FOUND = Relocalization(False, '5 detections are too few; turn the camera to more objects',
                               refusal_kind=RefusalKind.TOO_FEW_OBJECTS)
BOX = [10.0, 20.0, 60.0, 90.0]


def detections(class_id='a', score=0.9, box=BOX, count=5):
    return Detections(np.tile(np.array(box, dtype=np.float64), (count, 1)), (class_id,) * count,
                      np.full(count, score))


def checked(*frames, by_class=True):
    check = DetectorCheck(make_room(), by_class)
    for given in frames:
        check.add(given, given.usable(CAMERA.width, CAMERA.height, 50))
    return check


@pytest.mark.parametrize(('given', 'said'), [
    (detections('62'), '62, which are'), (detections(''), 'no name'),
    (detections('A'), "did you mean 'a'"), (detections('zebra\n[FATAL]' * 9), 'zebra [FATAL]'),
    (detections(score=np.nan), '5 scores'), (detections(score=np.inf), '5 scores'),
    (detections(box=[0.1, 0.2, 0.3, 0.4]), '0.2 x 0.2 px'),
    (detections(box=[60.0, 20.0, 10.0, 90.0]), '-50 x 70 px'),
    (detections(box=[np.nan] * 4), 'nan'), (detections(box=[900.0, 900.0, 950.0, 950.0]), '900')])
def test_detections_of_no_use_are_the_cause_of_a_refusal(given, said):
    check = checked(given)
    assert [fault.is_certain for fault in check.faults] == [True]
    found = check.explain(NOTHING_FOUND)
    assert found.refusal_kind is RefusalKind.WRONG_DETECTIONS
    assert said in found.reason and 'turn the camera' not in found.reason
    assert '\n' not in found.reason and len(found.reason) < 300


@pytest.mark.parametrize('check', [
    checked(), checked(detections('a')), checked(see_room(make_room())),
    checked(detections(count=0)), checked(detections('zebra'), by_class=False),
    checked(detections('zebra'), detections('a')),
    checked(detections(score=np.nan), detections(count=0))])
def test_other_refusals_stay(check):
    assert check.explain(NOTHING_FOUND) == NOTHING_FOUND


def test_a_stranger_or_two_among_frames_with_objects_are_named_and_no_fault_of_the_detector():
    check = checked(detections('a'), detections('zebra', count=2))
    assert check.faults == []
    found = check.explain(NOTHING_FOUND)
    assert found.refusal_kind is RefusalKind.TOO_FEW_OBJECTS and 'zebra' in found.reason


def test_a_fault_shows_over_frames_that_have_a_box_each():
    check = checked(*[detections('zebra', count=1)] * 2)
    assert check.faults == []
    check.add(*[detections('62', count=1)] * 2)
    assert check.faults[0].is_certain and '62' in check.faults[0].text


@pytest.mark.parametrize('score', [87.0, -0.5])
def test_odd_scores_are_doubted_and_used(score):
    check = checked(detections(score=score))
    assert [(fault.is_certain, f'{score:g}' in fault.text) for fault in check.faults] == [
        (False, True)]
    assert check.explain(NOTHING_FOUND) == NOTHING_FOUND


def test_an_accepted_pose_is_left_alone():
    """Keyframes alone may recognize a place."""
    accepted = Relocalization(True, '')
    assert checked(detections('zebra')).explain(accepted) == accepted
