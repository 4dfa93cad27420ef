# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Launch files: what they pass on exists; run where launch_ros is installed."""

import ast
import importlib.util
import runpy
from pathlib import Path

import pytest

from cliploc_ros.ros.tables import DETECTOR, RELOCALIZER

LAUNCH = Path(__file__).resolve().parents[1] / 'launch'
DEFAULTS = {'detector': {row.name: row.default for row in DETECTOR},
            'relocalizer': {row.name: row.default for row in RELOCALIZER}}
# arguments that are no parameters: where things are, and what ROS itself takes
OTHERS = {'map', 'image', 'camera_info', 'namespace', 'detector', 'use_sim_time', 'log_level'}


def constants(path):
    """The values that a file assigns to names, where these are literals."""
    found = {}
    for statement in ast.parse(path.read_text()).body:
        if isinstance(statement, ast.Assign):
            found[statement.targets[0].id] = ast.literal_eval(statement.value)
    return found


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_arguments_are_parameters_with_their_defaults(node):
    found = constants(LAUNCH / 'relocalization.launch.py')
    passed = found[f'_{node.upper()}_ARGUMENTS']
    assert len(passed) > 3
    for name in set(passed) - OTHERS:
        default = DEFAULTS[node][name]
        text = str(default).lower() if isinstance(default, bool) else default
        assert found['ARGUMENTS'][name][0] == text, name


def test_every_argument_is_used():
    found = constants(LAUNCH / 'relocalization.launch.py')
    used = {*found['_DETECTOR_ARGUMENTS'], *found['_RELOCALIZER_ARGUMENTS'], *OTHERS}
    assert set(found['ARGUMENTS']) == used


@pytest.mark.parametrize('path', sorted(LAUNCH.glob('*.launch.py')), ids=lambda path: path.name)
def test_descriptions_are_made(path):
    compile(path.read_text(), path, 'exec')
    if importlib.util.find_spec('launch_ros') is None:
        print(f'\nlaunch_ros is not installed here: {path.name} was compiled, not run')
        return
    description = runpy.run_path(str(path))['generate_launch_description']()
    assert description.entities
