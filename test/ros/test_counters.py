# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts of refusals by kind, and an answer that is withheld."""

from geometry_msgs.msg import PoseWithCovarianceStamped

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.ros.answer import Answer, RequestCounters, Verdict, answer_msg


def test_counts_add_up():
    counters = RequestCounters()
    counters.add(Answer(Verdict.ACCEPTED, 'x 1.00'))
    counters.add(Answer(Verdict.REFUSED, 'a reason', kind=RefusalKind.AMBIGUOUS))
    counters.add(Answer(Verdict.FAILED, 'no new frame'))
    values = counters.values()
    assert values['requests'] == 3
    assert [values[f'requests {verdict}'] for verdict in Verdict] == [1, 1, 0, 1]
    assert {kind: values[f'refused: {kind}'] for kind in RefusalKind if values[f'refused: {kind}']
            } == {'ambiguous': 1}


def test_a_withheld_answer_states_no_pose():
    withheld = Answer(Verdict.ACCEPTED, 'here', PoseWithCovarianceStamped(), map_hash='ab',
                      pose_figures={'x [m]': 1.0}).withheld('the robot moves')
    status, = answer_msg(withheld, '/relocalizer').status
    assert status.message == 'withheld: the robot moves (accepted: here; map ab); map ab'
    assert withheld.pose is None and 'x [m]' not in {value.key for value in status.values}
