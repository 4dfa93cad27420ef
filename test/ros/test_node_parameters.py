# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of real nodes: from files, changed at run time, and rejected."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from rclpy.parameter import Parameter

from cliploc_ros.errors import OptionsError
from cliploc_ros.ros.node.parameters import NodeParameters, Parameters, parameter
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

CONFIG = Path(__file__).resolve().parents[2] / 'config'


@dataclass(frozen=True)
class Probe(Parameters):
    low: int = parameter(1, 'Not above high.', low=0, high=100)
    high: int = parameter(5, 'Not below low.', low=0, high=100)
    ratio: float = parameter(0.5, 'A part.', low=0.0, high=1.0)
    mode: str = parameter('calm', 'How.', choices=('calm', 'wild'), read_only=True)
    span: list[float] = parameter([0.0, 1.0], 'From, to.', unit='m')

    def check(self):
        if self.low > self.high:
            raise OptionsError('low: above high')


@pytest.fixture
def declare(make_node, tmp_path):
    """Make a node with parameters from the text of a file; return it and its parameters."""
    def run(text='', kind=Probe):
        path = tmp_path / 'parameters.yaml'
        path.write_text(text or '/**:\n  ros__parameters:\n    use_sim_time: false\n')
        node = make_node(cli_args=['--ros-args', '--params-file', str(path)],
                         automatically_declare_parameters_from_overrides=True)
        return node, NodeParameters(node, kind)
    return run


def given(**values):
    lines = ''.join(f'    {name}: {value}\n' for name, value in values.items())
    return f'/**:\n  ros__parameters:\n{lines}'


def set_values(node, **values):
    return node.set_parameters_atomically(
        [Parameter(name, value=value) for name, value in values.items()])


@pytest.mark.parametrize(('name', 'kind'), [
    ('detector', DetectorParameters), ('relocalizer', RelocalizerParameters)])
def test_a_node_takes_the_generated_file(declare, name, kind, capfd):
    _, parameters = declare((CONFIG / f'{name}.yaml').read_text(), kind)
    assert parameters.snapshot() == kind()
    assert 'unknown parameter' not in capfd.readouterr().err


def test_values_are_taken_and_changed_whole_numbers_too(declare):
    node, parameters = declare(given(low=2, ratio=1, mode='wild', span='[1, 2]'))
    assert parameters.snapshot() == Probe(low=2, ratio=1.0, mode='wild', span=[1.0, 2.0])
    assert type(parameters.values.ratio) is float
    assert set_values(node, low=50, high=60).successful
    assert set_values(node, span=[2.0, 3.0]).successful
    assert parameters.snapshot() == Probe(low=50, high=60, ratio=1.0, mode='wild',
                                          span=[2.0, 3.0])


@pytest.mark.parametrize(('values', 'reason'), [
    ({'low': 101}, '0 to 100'), ({'low': 6}, 'low: above high')])
def test_an_invalid_start_is_reported_until_it_is_corrected(declare, values, reason):
    _, parameters = declare(given(**values))
    for _ in range(2):
        with pytest.raises(OptionsError) as raised:
            parameters.snapshot()
        assert reason in str(raised.value)


def test_mistyped_names_are_warned_of_with_the_nearest(declare, capfd):
    declare(given(ratoi=0.5, qqq=1) + '    map:\n      frame_id: map\n')
    log = capfd.readouterr().err
    assert log.count('unknown parameter') == 2 and "'ratoi'" in log and "'qqq'" in log
    assert log.count('did you mean') == 1 and "'ratio'?" in log
    assert 'map' not in log and 'use_sim_time' not in log


@pytest.mark.parametrize(('values', 'reason'), [
    ({'span': [1.0]}, 'span: '), ({'mode': 'wild'}, 'read-only'),
    ({'use_sim_time': False, 'high': 0}, 'low: above high')])
def test_a_refused_change_changes_nothing(declare, values, reason):
    node, parameters = declare()
    answer = set_values(node, **values)
    assert not answer.successful and reason in answer.reason
    assert parameters.snapshot() == Probe()


def test_the_map_does_not_change_at_run_time(declare):
    node, _ = declare(given() + '    map:\n      frame_id: map\n')
    answer = set_values(node, **{'map.frame_id': 'odom'})
    assert not answer.successful and 'at start-up' in answer.reason
    assert node.get_parameter('map.frame_id').value == 'map'
