# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import example, given
from hypothesis import strategies as st

from cliploc_ros.ros.node.diagnostics import (
    Diagnostics,
    Health,
    Stages,
    StageTimes,
    join_names,
    split_names,
)


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


def test_stages_in_numbers():
    stages = Stages()
    for ms in range(1, 101):
        stages.add({'search': float(ms)})
    assert stages.values() == {'search last [ms]': '100.0', 'search mean [ms]': '50.5',
                               'search p99 [ms]': '99.0'}
    for _ in range(1000):
        stages.add({'search': 7.0})
    assert stages.values()['search p99 [ms]'] == '7.0', 'old times no longer count'


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


def test_a_node_says_how_it_is_once_a_second(make_node, spin_until):
    health, heard = Health(values={'device': 'cpu'}), []
    node, listener = make_node('patient', namespace='robot_1'), make_node('doctor')
    Diagnostics(node, lambda: health, lambda: 'active')
    listener.create_subscription(
        DiagnosticArray, '/diagnostics', lambda msg: heard.append((time.monotonic(), msg)), 10)
    spin_until([node, listener], lambda: len(heard) >= 3, 'three reports')
    times, messages = zip(*heard, strict=True)
    assert times[2] - times[0] == pytest.approx(2.0, abs=0.5)
    status, = messages[0].status
    assert (status.level, status.name, status.message) == (
        DiagnosticStatus.OK, 'robot_1/patient: status', 'active')
    values = {value.key: value.value for value in status.values}
    assert (values['state'], values['device']) == ('active', 'cpu')
    assert 10 < float(values['memory [MiB]']) < 1e5
    health.fail('broken')
    heard.clear()
    spin_until([node, listener], lambda: heard, 'a report')
    assert heard[0][1].status[0].message == 'broken'
