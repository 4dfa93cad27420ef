# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Launch files pass on only what exists, and make their descriptions."""

import ast
import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from cliploc_ros.ros.parameter_tables import DETECTOR, RELOCALIZER

LAUNCH = Path(__file__).resolve().parents[1] / 'launch'
POLICY = LAUNCH.parent / 'config/security_policy.xml'
TABLES = {'detector': DETECTOR, 'relocalizer': RELOCALIZER}
# what both nodes have in their own names' namespaces, and what ROS has at its root
OWN = re.compile('/(detector|relocalizer|diagnostics|clock|parameter_events|rosout|tf(_static)?)'
                 '(/.*)?$')


@pytest.fixture
def constants():
    """The values that the launch file assigns to names, where these are literals."""
    found = {}
    for statement in ast.parse((LAUNCH / 'relocalization.launch.py').read_text()).body:
        if isinstance(statement, ast.Assign):
            found[statement.targets[0].id] = ast.literal_eval(statement.value)
    return found


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_arguments_are_parameters(constants, node):
    passed = constants[f'{node.upper()}_PARAMETERS'].keys()
    assert len(passed) > 3
    declared = {row.name for row in TABLES[node]} | {'use_sim_time'}
    assert {'map_file' if name == 'map' else name for name in passed} <= declared


def test_no_argument_means_two_things(constants):
    groups = [constants['NAMES'], constants['OTHERS'],
              constants['DETECTOR_PARAMETERS'] | constants['RELOCALIZER_PARAMETERS']]
    assert len(set().union(*groups)) == sum(map(len, groups))


def test_every_topic_and_service_can_be_remapped(constants):
    """The policy names them all; a test holds it equal to the graph."""
    names = {entry.text for entry in ElementTree.parse(POLICY).iter()
             if entry.tag in ('topic', 'service')}
    relative = {name[1:] for name in names if not OWN.match(name)}
    assert set(constants['NAMES']) | {'image/compressed'} == relative


def test_the_documents_give_arguments_that_exist(constants):
    arguments = set().union(*(constants[group] for group in (
        'NAMES', 'OTHERS', 'DETECTOR_PARAMETERS', 'RELOCALIZER_PARAMETERS')))
    given = set()
    for path in ('README.md', 'doc/nav2.md'):
        text = (LAUNCH.parent / path).read_text()
        # node arguments are written `-p name:=value` and `-r name:=name`
        given |= set(re.findall(r'(?<!-[pr] )\b(\w+):=', text))
    assert len(given) > 10
    assert given <= arguments


def test_nav2s_patience_is_longer_than_ours():
    text = (LAUNCH.parent / 'doc/nav2.md').read_text()
    tree = re.search(r'    <Parallel.*</Parallel>', text, re.DOTALL).group()
    call = ElementTree.fromstring(tree).find('ReinitializeGlobalLocalization')
    timeout_s = next(row.default for row in RELOCALIZER if row.name == 'timeout_s')
    assert int(call.get('server_timeout')) > 1000 * (timeout_s + 2.0)


@pytest.mark.needs('launch_ros')
@pytest.mark.parametrize('path', sorted(LAUNCH.glob('*.launch.py')), ids=lambda path: path.name)
def test_descriptions_are_made(path):
    from launch import LaunchContext
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    description = runpy.run_path(str(path))['generate_launch_description']()
    context, made = LaunchContext(), []
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument | OpaqueFunction):
            made += entity.visit(context) or []
    assert len(made) == (2 if path.name == 'relocalization.launch.py' else 0)
