# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Launch files pass on only existing arguments, and produce their descriptions."""

import ast
import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from cliploc_ros.cli.wake_up import make_parser
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

pytestmark = pytest.mark.full

LAUNCH = Path(__file__).resolve().parents[1] / 'launch'
POLICY = LAUNCH.parent / 'config/security_policy.xml'
DOCUMENTS = [LAUNCH.parent / 'README.md', *sorted((LAUNCH.parent / 'doc').glob('*.md'))]
TABLES = {'detector': DetectorParameters.rows(), 'relocalizer': RelocalizerParameters.rows()}
# names in the private namespaces of both nodes, and ROS's names at the root
OWN = re.compile('/(detector|relocalizer|wake_up|diagnostics|clock|parameter_events|rosout|'
                 'tf(_static)?)(/.*)?$')


def relocalization_launch() -> list[ast.stmt]:
    """Return the statements of the launch file, which cannot be imported without launch_ros."""
    return ast.parse((LAUNCH / 'relocalization.launch.py').read_text()).body


def literals(statements: list[ast.stmt]) -> dict:
    """Return the literal values that are assigned to names."""
    return {statement.targets[0].id: ast.literal_eval(statement.value)
            for statement in statements if isinstance(statement, ast.Assign)}


@pytest.fixture
def constants():
    return literals(relocalization_launch())


@pytest.fixture
def of_wake_up():
    """Return the arguments of wake_up.launch.py: defaults and descriptions."""
    return literals(ast.parse((LAUNCH / 'wake_up.launch.py').read_text()).body)['ARGUMENTS']


@pytest.fixture
def arguments(constants):
    """Return the names of all launch arguments."""
    return set().union(*(constants[group] for group in (
        'NAMES', 'OTHERS', 'DETECTOR_PARAMETERS', 'RELOCALIZER_PARAMETERS')))


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_arguments_are_parameters(constants, node):
    passed = constants[f'{node.upper()}_PARAMETERS'].keys()
    assert len(passed) > 3
    declared = {row.name for row in TABLES[node]} | {'use_sim_time'}
    assert passed <= declared


def test_every_topic_and_service_can_be_remapped(constants):
    """The policy names them all; a test compares it with the graph."""
    names = {entry.text for entry in ElementTree.parse(POLICY).iter()
             if entry.tag in ('topic', 'service')}
    relative = {name[1:] for name in names if not OWN.match(name)}
    assert set(constants['NAMES']) | {'image/compressed', 'depth/compressedDepth'} == relative


def test_a_wake_up_is_launched_with_its_own_options(of_wake_up):
    text = (LAUNCH / 'wake_up.launch.py').read_text()
    options = make_parser().parse_args([])
    assert set(re.findall(r"'--([a-z-]+)', LaunchConfiguration", text)) - {'log-level'} == {
        name.replace('_', '-') for name in vars(options)}
    assert of_wake_up['relocalizer'][0] == options.relocalizer
    assert float(of_wake_up['wake_up_timeout'][0]) == options.timeout
    assert float(of_wake_up['wake_up_turn_deg'][0]) == options.turn_deg


def test_the_documents_give_arguments_that_exist(arguments, of_wake_up):
    given = set()
    for path in DOCUMENTS:
        # node arguments are written `-p name:=value` and `-r name:=name`
        given |= set(re.findall(r'(?<!-[pr] )\b([a-z]\w*):=', path.read_text()))
    assert len(given) > 10
    assert given <= arguments | of_wake_up.keys()


def test_nav2_calls_our_service_and_waits_long_enough():
    text = (LAUNCH.parent / 'doc/nav2.md').read_text()
    tree = re.search(r'    <Parallel.*</Parallel>', text, re.DOTALL).group()
    call = ElementTree.fromstring(tree).find('ReinitializeGlobalLocalization')
    (name,) = set(re.findall(r'reinitialize_global_localization:=(\w+)', text))
    assert call.get('service_name') == name != 'reinitialize_global_localization'
    timeout_s = RelocalizerParameters().timeout_s
    assert int(call.get('server_timeout')) > 1000 * (timeout_s + 2.0)


def made(name: str, **given: str) -> list:
    """Return the nodes that a launch file makes."""
    from launch import LaunchContext
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    description = runpy.run_path(str(LAUNCH / name))['generate_launch_description']()
    context, nodes = LaunchContext(), []
    context.launch_configurations.update(given)
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument | OpaqueFunction):
            nodes += entity.visit(context) or []
    return nodes


@pytest.mark.needs('launch_ros')
@pytest.mark.parametrize(('name', 'nodes'), [
    ('relocalization.launch.py', 2), ('wake_up.launch.py', 0)])
def test_descriptions_are_made(name, nodes):
    assert len(made(name)) == nodes


@pytest.mark.needs('launch_ros')
def test_a_missing_parameter_file_stops_the_launch(tmp_path):
    with pytest.raises(RuntimeError, match='no such file'):
        made('relocalization.launch.py', parameters=str(tmp_path / 'robot.yaml'))
