# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import array
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.messages import parse_class_map
from cliploc_ros.ros.node.parameters import ParameterRow
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

TEXT = ParameterRow('text', 'a', 'Some text.')
CHOICE = ParameterRow('choice', 'raw', 'One of two.', choices=('raw', 'compressed'))
COUNT = ParameterRow('count', 3, 'How many.', low=1, high=10)
LENGTH = ParameterRow('length', 0.5, 'How long.', unit='m', low=0.0, high=2.0)
SWITCH = ParameterRow('switch', False, 'On or off.')
MOUNT = ParameterRow('mount', [0.0, 0.0], 'Two numbers.', unit='m')
NAMES = ParameterRow('names', [''], 'Some texts.')

TABLES = {'detector': DetectorParameters.rows(), 'relocalizer': RelocalizerParameters.rows()}


@pytest.mark.parametrize(('row', 'value', 'validated'), [
    (LENGTH, 1, 1.0), (MOUNT, array.array('q', [3, 4]), [3.0, 4.0]),
    (NAMES, ('a', 'b'), ['a', 'b'])])
def test_good_values_come_back_in_the_parameters_type(row, value, validated):
    result = row.validated(value)
    assert result == validated and type(result) is type(validated)
    if isinstance(result, list):
        assert all(type(item) is type(row.default[0]) for item in result)


@pytest.mark.parametrize(('row', 'value', 'message'), [
    (TEXT, 1, 'str, not int'), (CHOICE, 'compresed', "mean 'compressed'"), (COUNT, 0, '1 to 10'),
    (COUNT, 11, '1 to 10'), (COUNT, 3.0, 'int, not float'), (COUNT, True, 'int, not bool'),
    (LENGTH, math.nan, 'nan'), (MOUNT, [1.0], '2 finite'), (MOUNT, [1.0, -math.inf], '2 finite'),
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


@pytest.mark.parametrize('name', TABLES)
def test_tables_are_sound(name):
    names = [row.name for row in TABLES[name]]
    assert len(set(names)) == len(names)
    for row in TABLES[name]:
        assert row.validated(row.default) == row.default
        assert row.description.endswith('.') and '|' not in row.description


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
    ({'height_range_m': [2.0, 1.0]}, 'height_range_m'),
    ({'gravity': 'base_frame'}, 'base_frame'),
    ({'publish_tf': True}, 'publish_tf'),
    ({'base_from_camera': [0.0] * 6 + [2.0]}, 'base_from_camera')])
def test_values_that_do_not_fit_together(changes, message):
    with pytest.raises(OptionsError, match=message):
        RelocalizerParameters(**changes).check()


def test_classes_get_the_maps_names():
    given = RelocalizerParameters(class_map=' tvmonitor=tv , potted plant = plant,')
    assert parse_class_map(given.class_map) == {'tvmonitor': 'tv', 'potted plant': 'plant'}
    assert parse_class_map(RelocalizerParameters().class_map) == {}
