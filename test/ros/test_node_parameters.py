# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of real nodes: from files, changed at run time, and rejected."""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.parameter import Parameter

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.messages import parse_class_map
from cliploc_ros.ros.node.parameters import NodeParameters, ParameterRow, Parameters, parameter
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

CONFIG = Path(__file__).resolve().parents[2] / 'config'
KINDS = {'detector': DetectorParameters, 'relocalizer': RelocalizerParameters}


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


def file_of(**values):
    lines = ''.join(f'    {name}: {value}\n' for name, value in values.items())
    return f'/**:\n  ros__parameters:\n{lines}'


def set_values(node, **values):
    return node.set_parameters_atomically(
        [Parameter(name, value=value) for name, value in values.items()])


@pytest.mark.parametrize(('name', 'kind'), KINDS.items())
def test_a_node_takes_the_generated_file(declare, name, kind, capfd):
    _, parameters = declare((CONFIG / f'{name}.yaml').read_text(), kind)
    assert parameters.snapshot() == kind()
    assert 'unknown parameter' not in capfd.readouterr().err


def test_values_are_taken_and_changed_whole_numbers_too(declare):
    node, parameters = declare(file_of(low=2, ratio=1, mode='wild', span='[1, 2]'))
    assert parameters.snapshot() == Probe(low=2, ratio=1.0, mode='wild', span=[1.0, 2.0])
    assert type(parameters.values.ratio) is float
    assert set_values(node, low=50, high=60).successful
    assert set_values(node, span=[2.0, 3.0]).successful
    assert parameters.snapshot() == Probe(low=50, high=60, ratio=1.0, mode='wild', span=[2.0, 3.0])


@pytest.mark.parametrize(('values', 'reason'), [
    ({'low': 101}, '0 to 100'), ({'low': 6}, 'low: above high')])
def test_an_invalid_start_is_reported_until_it_is_corrected(declare, values, reason):
    _, parameters = declare(file_of(**values))
    for _ in range(2):
        with pytest.raises(OptionsError) as raised:
            parameters.snapshot()
        assert reason in str(raised.value)


def test_mistyped_names_are_warned_of_with_the_nearest(declare, capfd):
    declare(file_of(ratoi=0.5, qqq=1) + '    map:\n      frame_id: map\n')
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
    node, _ = declare(file_of() + '    map:\n      frame_id: map\n')
    answer = set_values(node, **{'map.frame_id': 'odom'})
    assert not answer.successful and 'at start-up' in answer.reason
    assert node.get_parameter('map.frame_id').value == 'map'


# ---- rows of the tables -------------------------------------------------------------------------

TEXT = ParameterRow('text', 'a', 'Some text.')
CHOICE = ParameterRow('choice', 'raw', 'One of two.', choices=('raw', 'compressed'))
COUNT = ParameterRow('count', 3, 'How many.', low=1, high=10)
LENGTH = ParameterRow('length', 0.5, 'How long.', unit='m', low=0.0, high=2.0)
SWITCH = ParameterRow('switch', False, 'On or off.')
MOUNT = ParameterRow('mount', [0.0, 0.0], 'Two numbers.', unit='m')
NAMES = ParameterRow('names', [''], 'Some texts.')


@pytest.mark.parametrize(('row', 'value', 'message'), [
    (TEXT, 1, 'str, not int'), (CHOICE, 'compresed', "mean 'compressed'"), (COUNT, 0, '1 to 10'),
    (COUNT, 11, '1 to 10'), (COUNT, 3.0, 'int, not float'), (COUNT, True, 'int, not bool'),
    (LENGTH, math.nan, 'nan'), (MOUNT, [1.0], '2 finite'), (MOUNT, [1.0, -math.inf], '2 finite'),
    (ParameterRow('span', [0.0], '', low=0.0, high=2.0), [3.0], '0 to 2'),
    (MOUNT, '12', '2 finite'), (NAMES, ['a', 1], 'texts'), (NAMES, 'a', 'texts')])
def test_a_bad_value_is_refused_by_name_and_with_what_is_allowed(row, value, message):
    with pytest.raises(OptionsError, match=message) as raised:
        row.validated(value)
    assert str(raised.value).startswith(f'{row.name}: ') and len(str(raised.value)) < 200


@given(st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary(),
    st.lists(st.one_of(st.integers(-2**63, 2**63 - 1), st.floats(), st.text()), max_size=4)))
def test_whatever_comes_it_is_allowed_or_refused(value):
    for row in (TEXT, CHOICE, COUNT, LENGTH, SWITCH, MOUNT, NAMES):
        try:
            validated = row.validated(value)
        except OptionsError as error:
            assert row.name in str(error)
        else:
            assert type(validated) is type(row.default)
            assert row.validated(validated) == validated
            if row in (COUNT, LENGTH):
                assert row.low <= validated <= row.high


def test_the_methods_options_are_parameters_of_equal_defaults_and_limits():
    # an offline search is not limited in time, but a client waits for an answer
    assert RelocalizerParameters().options() == RelocalizerOptions(time_budget_s=0.05)
    rows = {row.name: row for row in RelocalizerParameters.rows()}
    for name in ('iterations', 'iou_threshold', 'min_inliers', 'k'):
        for end in (rows[name].low, rows[name].high):
            value = type(rows[name].default)(end)
            options = RelocalizerParameters(**{name: value}).options()
            assert getattr(options, name) == value


@pytest.mark.parametrize(('changes', 'message'), [
    ({'matching': 'class', 'algorithm': 'b-prosac'}, "'b-prosac' needs "),
    *(({'class_map': text}, 'class_map') for text in ('tv', 'tv=', '=tv', 'a=b, a=c')),
    ({'height_range_m': [2.0, 1.0]}, 'height_range_m'), ({'gravity': 'base_frame'}, 'base_frame'),
    *(({'tilt_deviation_deg': value}, '0.1 and 60, or be 0') for value in (1e-308, 0.09, 61.0)),
    ({'publish_tf': True}, 'publish_tf'), ({'mount_deviation': [-1.0, 0.0]}, 'mount_deviation'),
    ({'base_from_camera': [0.0] * 6 + [2.0]}, 'base_from_camera')])
def test_values_that_do_not_fit_together(changes, message):
    with pytest.raises(OptionsError, match=message):
        RelocalizerParameters(**changes).check()


def test_classes_get_the_maps_names():
    given = RelocalizerParameters(class_map=' tvmonitor=tv , potted plant = plant,')
    assert parse_class_map(given.class_map) == {'tvmonitor': 'tv', 'potted plant': 'plant'}
    assert parse_class_map(RelocalizerParameters().class_map) == {}
