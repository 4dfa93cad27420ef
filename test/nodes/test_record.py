# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A failed request in the field becomes a test case, as long as there is room for it."""

import hashlib

import numpy as np
from scene import make_room, see_room
from tester import make_frame

from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.core.query import read_case
from cliploc_ros.messages import image_from_msg


def four_of(rows=(0, 3, 6, 9)):
    """Return a frame with four objects of one class in wrong places, which fits no pose."""
    seen = see_room(make_room()).select(np.array(rows))
    boxes = seen.bboxes_xyxy[::-1] + np.array([0.0, 40.0, 0.0, 40.0])
    return make_frame(type(seen)(boxes, seen.class_ids, seen.scores))


def test_a_recorded_failure_replays_to_the_same_verdict(own_relocalizer, tester, room_map,
                                                        tmp_path, capsys):
    own_relocalizer(record_folder=tmp_path / 'cases', algorithm='auto', record_limit_mb=1)
    assert not tester.trigger('record').success, 'no request yet'
    answer = tester.relocalize(four_of())
    assert answer.message.startswith('refused: ')
    stored = tester.trigger('record')  # 0.9 MiB
    assert stored.success, stored.message
    (case,) = (tmp_path / 'cases').iterdir()
    assert case.name.endswith('_refused.npz')
    assert stored.message == f'{case}: 1 frames; {answer.message}'
    assert evaluate(['--bag', str(case), '--map', str(room_map)]) == 0
    output = capsys.readouterr().out
    assert output.endswith('the same verdict\n')
    assert f'again (pose of the camera): {answer.message.rpartition("; ")[0]}; ' in output
    assert f'map {hashlib.sha256(room_map.read_bytes()).hexdigest()[:12]}\n' in output
    found = read_case(case)
    np.testing.assert_array_equal(found.queries[0].images[0], image_from_msg(four_of()[0]))
    full = tester.trigger('record')
    assert not full.success and 'record_limit_mb' in full.message
    assert len(list((tmp_path / 'cases').iterdir())) == 1
    assert tester.set_parameter('timeout_s', 1.0).successful
    assert 'no new frame' in tester.answer(tester.ask()).message
    assert not tester.trigger('record').success
