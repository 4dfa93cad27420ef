# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The programs accept every command in the documents, and the nodes what launch files pass."""

import argparse
import ast
import importlib
import re
import runpy
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

import pytest
import yaml

from cliploc_ros.cli.wake_up import make_parser
from cliploc_ros.command import split_ros_args
from cliploc_ros.core.watch.watch import WatchState
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

PROJECT = Path(__file__).resolve().parents[1]
PAGES = [PROJECT / 'README.md', PROJECT / 'CONTRIBUTING.md', PROJECT / 'SECURITY.md',
         PROJECT / 'studies/README.md', *sorted((PROJECT / 'doc').glob('*.md'))]
_BEGINS_SHELL = re.compile(r'(ros2|script/|python3? -|install/lib/cliploc_ros/|cliploc_\w+ |'
                           r'source |pip |sudo |\w+=\$|until |rviz2 |(evaluate|build_map) -)')
_FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
# A block is indented by four spaces, or by eight in a list; text of a list item is not a block.
_INDENTED = re.compile(r'(?<=\n\n)(?: {4,}\S.*\n(?:\n(?= {4}))?)+')
_OPERATORS = {'|', ';', '&&', '&', '||'}
_WORDS = {'until', 'do', 'then', 'while', 'if'}
pytestmark = pytest.mark.full

NODES = {'detector': DetectorParameters.rows(), 'relocalizer': RelocalizerParameters.rows()}
EXECUTABLES = {path.stem for path in (PROJECT / 'cliploc_ros/cli').glob('*.py')
               if 'def make_parser' in path.read_text()}
OF_STUDIES = ('studies.speed.',)
MODULES = re.compile(r'(cliploc_ros|demo|studies)\.')


class Command(NamedTuple):
    """A program with its arguments, and the page that contains it."""

    page: str
    words: tuple[str, ...]


def commands() -> list[Command]:
    """Return every command of every page, without duplicates."""
    return list(dict.fromkeys(command for page in PAGES for command in commands_of(page)))


def commands_of(page: Path) -> list[Command]:
    """Return the commands of the shell blocks of a page, in their order."""
    return commands_in(page.read_text(), page.name)


def commands_in(text: str, page: str) -> list[Command]:
    """Return the commands of the shell blocks of a text, in their order."""
    return [Command(page, words) for block in shell_blocks(text)
            for line in block.replace('\\\n', ' ').splitlines() for words in split(line)]


def shell_blocks(text: str) -> list[str]:
    """Return the fenced blocks marked sh, and the indented blocks that begin with a command."""
    fenced = [body for language, body in _FENCE.findall(text) if language == 'sh']
    indented = [match.group() for match in _INDENTED.finditer(_FENCE.sub('', text))]
    return fenced + [block for block in indented if _BEGINS_SHELL.match(block.lstrip())]


def split(line: str) -> Iterator[tuple[str, ...]]:
    """Split a line into its commands; the content of $( ) is a separate command."""
    line = re.sub(r'(?<=\s)\[|\](?=\s|$)', '', line)  # [--option] may be left out
    for inner in re.findall(r'\$\(([^)]*)\)', line):
        yield from split(inner)
    lexer = shlex.shlex(re.sub(r'\$\([^)]*\)', 'SUBSTITUTED', line), posix=True,
                        punctuation_chars=';&|')
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ';']:
        if word not in _OPERATORS:
            words.append(word)
            continue
        while words and (words[0] in _WORDS or re.match(r'\w+=', words[0])):
            del words[0]
        if words:
            yield tuple(words)
        words = []


def inline_commands() -> list[Command]:
    """Return the commands within sentences that have at least one option."""
    found = []
    for page in PAGES:
        text = _INDENTED.sub('', _FENCE.sub('', page.read_text()))
        for code in re.findall(r'`([^`]+)`', text):
            words = code.replace('\n', ' ').split()
            if len(words) > 1 and any(word.startswith('--') for word in words[1:]):
                found.append(Command(page.name, tuple(words)))
    return list(dict.fromkeys(found))


@cache
def parser_of(module: str) -> argparse.ArgumentParser:
    """Return the parser of a program, by its module."""
    if module.startswith(('cliploc_ros.cli.', 'demo.__', 'studies.reproduce')):
        return importlib.import_module(module).make_parser()

    found: list[argparse.ArgumentParser] = []
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(argparse.ArgumentParser, 'parse_args',
                      lambda parser, *_: sys.exit(found.append(parser)))
        patch.setattr(sys, 'argv', [module])
        if module.startswith(OF_STUDIES):
            importlib.import_module(module).run([])
        else:
            runpy.run_module(module, run_name='__main__')
    return found[0]


def program_of(command: Command) -> tuple[str, list[str]]:
    """Return the module that runs a command of this package ('' for others), and the arguments."""
    first, *rest = command.words
    if first == 'ros2' and rest[:2] == ['run', 'cliploc_ros']:
        first, *rest = rest[1:]
        first, *rest = rest
    elif first in ('python', 'python3') and rest[0] == '-m' and MODULES.match(rest[1]):
        if rest[1] + '.' in OF_STUDIES:
            return f'{rest[1]}.{rest[2]}', rest[3:]
        return rest[1], rest[2:]
    elif first == 'script/demo':
        return 'demo.__main__', rest
    elif first == 'script/reproduce':
        return 'studies.reproduce', rest
    name = re.sub('^(install/lib/cliploc_ros/|cliploc_(?!ros))', '', first)
    if name in EXECUTABLES:
        return f'cliploc_ros.cli.{name}', rest
    return (f'cliploc_ros.nodes.{name}', rest) if name in NODES else ('', [])


# runpy warns if another test has imported the module that it runs.
AS_MAIN = pytest.mark.filterwarnings('ignore:.* found in sys.modules:RuntimeWarning')


@AS_MAIN
@pytest.mark.parametrize('command', commands(), ids=str)
def test_a_command_is_accepted(command, capsys):
    module, arguments = program_of(command)
    plain, ros = split_ros_args(arguments)
    if module.startswith('cliploc_ros.nodes.'):
        assert plain == []
        check_node(module.rpartition('.')[2], ros)
    elif module:
        try:
            parser_of(module).parse_args(plain)
        except SystemExit:
            pytest.fail(capsys.readouterr().err)
    elif command.words[0] == 'ros2':
        check_ros2(command.words[1:])


def check_node(node: str, ros_args: list[str]) -> None:
    """Check parameters and remappings against the node's tables and topics."""
    rows = {row.name: row for row in NODES[node]}
    options = iter(ros_args[1:])
    for option in options:
        value = next(options)
        name, assigned, text = value.partition(':=')
        if option == '-p':
            assert assigned
            assert rows[name].validated(yaml.safe_load(text)) is not None
        elif option == '-r':
            assert name in names_of_interface() | {'__node', '__ns'}, name
        else:
            assert option in ('--params-file', '--enclave', '--log-level'), option


@cache
def names_of_policy() -> set[str]:
    """Return the names of topics and services; a test compares them with the graph."""
    policy = ElementTree.parse(PROJECT / 'config/security_policy.xml')
    return {entry.text or '' for entry in policy.iter() if entry.tag in ('topic', 'service')}


def names_of_interface() -> set[str]:
    """Return topics and services, absolute and relative."""
    names = names_of_policy()
    return names | {name.removeprefix('/') for name in names} | {'image/compressed'}


def check_ros2(words: tuple[str, ...]) -> None:
    """Check the parts of a ros2 command that refer to this package."""
    verb, *rest = words
    if verb == 'launch':
        package, file, *_ = rest
        assert package == 'cliploc_ros'
        assert (PROJECT / 'launch' / file).is_file()  # the arguments are checked below
    elif verb == 'service':
        assert rest[0] == 'call' and rest[1] in names_of_interface()
    elif verb == 'param':
        action, node, name, *value = rest
        row = {row.name: row for row in NODES[node.removeprefix('/')]}[name]
        assert len(value) == {'get': 0, 'set': 1}[action]
        assert not value or row.validated(yaml.safe_load(value[0])) is not None


@AS_MAIN
@pytest.mark.parametrize('command', [one for one in inline_commands() if program_of(one)[0]],
                         ids=str)
def test_an_option_in_a_sentence_exists(command):
    """A sentence may omit required arguments, so only the options are checked."""
    module, arguments = program_of(command)
    parser = parser_of(module)
    if parser._subparsers is not None:
        parser = parser._subparsers._group_actions[0].choices[arguments[0]]
    for word in arguments:
        if word.startswith('--') and len(word) > 2 and word != '--ros-args':
            assert word.partition('=')[0] in parser._option_string_actions, word


def test_the_example_of_the_library_runs():
    text = (PROJECT / 'doc/library.rst').read_text()
    code = dedent(re.search(r'code-block:: python\n\n((?: {3}.*\n|\n)+)', text).group(1))
    done = subprocess.run([sys.executable, '-c', code], cwd=PROJECT, text=True,
                          capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('True  [[')


def test_pages_have_commands():
    """Otherwise a change of the pages' layout could hide all of them from these tests."""
    pages = {command.page for command in commands()}
    assert {'README.md', 'install.md', 'nav2.md', 'your_robot.md', 'SECURITY.md'} <= pages


# ---- launch files pass on only existing arguments, and produce their descriptions
LAUNCH = PROJECT / 'launch'
# names in the private namespaces of both nodes, and ROS's names at the root
OWN = re.compile('/(detector|relocalizer|wake_up|diagnostics|clock|parameter_events|rosout|'
                 'tf(_static)?)(/.*)?$')


def literals(name: str) -> dict:
    """Return the literals assigned in a launch file, which cannot be imported without ROS."""
    return {statement.targets[0].id: ast.literal_eval(statement.value)
            for statement in ast.parse((LAUNCH / name).read_text()).body
            if isinstance(statement, ast.Assign)}


PASSED = literals('relocalization.launch.py')
OURS = 'reinitialize_global_localization'
#: Arguments of wake_up.launch.py: defaults and descriptions.
OF_WAKE_UP = literals('wake_up.launch.py')['ARGUMENTS']


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_arguments_are_parameters(node):
    passed = PASSED[f'{node.upper()}_PARAMETERS'].keys()
    assert len(passed) > 3
    declared = {row.name for row in NODES[node]} | {'use_sim_time'}
    assert passed <= declared


def test_every_topic_and_service_can_be_remapped():
    """The policy names them all; a test compares it with the graph. Those of Nav2 remain."""
    relative = {name[1:] for name in names_of_policy() if not OWN.match(name)
                and name != '/map' and '/map_server/' not in name and 'costmap' not in name}
    assert set(PASSED['NAMES']) | {'image/compressed', 'depth/compressedDepth'} == relative


def test_a_wake_up_is_launched_with_its_own_options():
    text = (LAUNCH / 'wake_up.launch.py').read_text()
    options = make_parser().parse_args([])
    assert set(re.findall(r"'--([a-z-]+)', LaunchConfiguration", text)) - {'log-level'} == {
        name.replace('_', '-') for name in vars(options)}
    assert OF_WAKE_UP['relocalizer'][0] == options.relocalizer
    assert float(OF_WAKE_UP['wake_up_timeout'][0]) == options.timeout
    assert float(OF_WAKE_UP['wake_up_turn_deg'][0]) == options.turn_deg


def test_the_documents_give_arguments_that_exist():
    given = set()
    for path in (PROJECT / 'README.md', *(PROJECT / 'doc').glob('*.md')):
        # node arguments are written `-p name:=value` and `-r name:=name`
        given |= set(re.findall(r'(?<!-[pr] )\b([a-z]\w*):=', path.read_text()))
    assert len(given) > 10
    assert given <= OF_WAKE_UP.keys() | set().union(*(PASSED[group] for group in (
        'NAMES', 'OTHERS', 'DETECTOR_PARAMETERS', 'RELOCALIZER_PARAMETERS')))


# Ports of the nodes in our tree: nav2_tree_nodes.xml of Nav2 1.3 (Jazzy), BehaviorTree.CPP 4
PORTS = {
    'root': 'BTCPP_format main_tree_to_execute', 'BehaviorTree': 'ID', 'SubTree': 'ID _autoremap',
    'Sequence': '', 'ReactiveSequence': '', 'PipelineSequence': '', 'RoundRobin': '',
    'Parallel': 'success_count failure_count', 'ScriptCondition': 'code',
    'RecoveryNode': 'number_of_retries', 'RateController': 'hz', 'Wait': 'wait_duration',
    'Spin': 'spin_dist time_allowance', 'FollowPath': 'path controller_id goal_checker_id',
    'ComputePathToPose': 'goal path planner_id', 'ClearEntireCostmap': 'service_name',
    'GoalCheckerSelector': 'topic_name default_goal_checker selected_goal_checker',
    'ReinitializeGlobalLocalization': 'service_name server_timeout'}


def test_nav2_calls_our_service_and_waits_long_enough():
    """Our tree has known ports, and states, names and types of the relocalizer."""
    assert "files('config', '*.*')" in (PROJECT / 'setup.py').read_text(), 'it is installed'
    page, types = ((PROJECT / f'doc/{name}.md').read_text() for name in ('nav2', 'interface'))
    (name,) = set(re.findall(r'reinitialize_global_localization:=(\w+)', page))
    tree = ElementTree.parse(PROJECT / 'config/navigate_unless_lost.xml').getroot()
    for node in tree.iter():
        assert node.attrib.keys() <= {'name', *PORTS[node.tag].split()}, node.tag
    trees = {each.get('ID'): each for each in tree.iter('BehaviorTree')}
    assert {tree.get('main_tree_to_execute'), *(each.get('ID') for each in tree.iter('SubTree'))
            } == trees.keys() == set(re.findall('^\\| `([A-Z]\\w+)` \\| ', page, re.MULTILINE))
    calls = list(tree.iter('ReinitializeGlobalLocalization'))
    assert {call.get('service_name') for call in calls} == {name} != {OURS}
    assert f'| `{OURS}` | std_srvs/Empty |' in types
    assert min(int(call.get('server_timeout')) for call in calls
               ) > 1000 * (RelocalizerParameters().timeout_s + 2.0)
    (state,) = tree.iter('GoalCheckerSelector')
    assert state.get('topic_name') in names_of_interface()
    assert '| `~/localization_state` | std_msgs/String |' in types
    variable = state.get('selected_goal_checker').strip('{}')
    compared = {tuple(node.get('code').replace('!=', '==').split(' == '))
                for node in tree.iter('ScriptCondition')}
    assert compared == {(variable, f"'{WatchState.LOST}'")}
    assert state.get('default_goal_checker') == WatchState.UNCERTAIN
    spin = (PROJECT / 'script/nav2_msgs/action/Spin.action').read_text()
    assert 'float32 target_yaw' in spin  # the port spin_dist


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
