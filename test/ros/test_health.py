# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from hypothesis import example, given
from hypothesis import strategies as st

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.ros.answer import Answer, RequestCounters, Verdict, answer_msg
from cliploc_ros.ros.node.diagnostics import Health, StageTimes, join_names, split_names


def test_the_worst_problem_gives_the_level_and_comes_first():
    health = Health()
    assert (health.level, health.message) == (DiagnosticStatus.OK, '')
    health.warn('late')
    health.fail('broken')
    health.warn('slow')
    assert (health.level, health.message) == (DiagnosticStatus.ERROR, 'broken; late; slow')


@given(st.lists(st.text(st.characters(exclude_characters='\0', exclude_categories=['Cs']),
                        min_size=1)))
@example(['a chair, broken', 'the "best" one', 'line\nbreak', ' mug '])
def test_names_of_any_text_survive_the_diagnostics(names):
    assert split_names(join_names(names)) == tuple(names)


def test_stages_of_one_result_follow_each_other():
    now = time.monotonic()
    times = StageTimes('waiting', now - 9.0)
    times.begin('search', now - 7.0)
    times.begin('CLIP', now - 6.0)
    times.begin('search', now - 1.0)
    assert list(times.ms) == ['waiting', 'search', 'CLIP']
    assert times.ms['waiting'] == pytest.approx(2000.0)
    assert times.ms['CLIP'] == pytest.approx(5000.0)
    assert 2000.0 <= times.ms['search'] < 2500.0, 'the running stage counts up to now'


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
    assert status.message == 'withheld: the robot moves (accepted: here)'
    assert withheld.pose is None and 'x [m]' not in {value.key for value in status.values}
