# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The package: versions, imports, licence lines, executables and interfaces."""

import ast
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
MODULES = sorted((PROJECT / 'cliploc_ros').rglob('*.py'))
SOURCES = [*MODULES, PROJECT / 'setup.py', *(
    path for folder in ('demo', 'studies', 'test')
    for path in sorted((PROJECT / folder).rglob('*.py')))]
SCRIPTS = [path for path in sorted((PROJECT / 'script').iterdir()) if path.is_file()]
INTERFACES = sorted((PROJECT / 'cliploc_ros/offline/datasets/vision_msgs/msg').glob('*.msg'))
EXECUTABLES = ['build_map', 'check_map', 'detector', 'import_map',
               'relocalizer', 'replay', 'studio', 'tum_to_bag', 'wake_up']
# As in vision_msgs 4.1.1 of Jazzy. The hash covers the other six messages as well.
DETECTIONS_TYPE_HASH = 'RIHS01_214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968'


def run_python(code: str, cwd: Path) -> str:
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=cwd, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(('package', 'absent'), [
    ('cliploc_ros', {'rclpy', 'torch', 'numpy'}),
    ('cliploc_ros.core', {'rclpy', 'torch', 'ultralytics', 'open_clip'})])
def test_importing_it_imports_no_more_than_it_needs(package, absent):
    code = (
        'import importlib, pkgutil, sys\nbefore = set(sys.modules)\n'
        f'folder = importlib.import_module({package!r})\n'
        f'if {package != "cliploc_ros"}:\n'
        f'    for module in pkgutil.walk_packages(folder.__path__, {package + "."!r}):\n'
        '        importlib.import_module(module.name)\n'
        f'print({absent} & (set(sys.modules) - before))\n')
    assert run_python(code, cwd=PROJECT).strip() == 'set()'


def imported(path: Path) -> set[str]:
    """Return the packages that a file imports anywhere in it."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.partition('.')[0] for name in names}


def test_every_ros_package_that_is_imported_is_declared():
    sources = [*MODULES, *(PROJECT / 'launch').glob('*.py')]
    used = {name for path in sources for name in imported(path)
            if re.search('^(launch|rclpy|tf2)|_(msgs|srvs|interfaces)$', name)}
    manifest = ElementTree.parse(PROJECT / 'package.xml')
    declared = {entry.text for entry in manifest.findall('exec_depend')}
    # on Jazzy the Python part of tf2_ros is a separate package
    assert {{'tf2_ros': 'tf2_ros_py'}.get(name, name) for name in used} <= declared


def test_files_name_their_licence():
    lines = ('SPDX-FileCopyrightText: 2026 the cliploc_ros authors\n',
             'SPDX-License-Identifier: Apache-2.0\n')
    assert [str(path) for path in (*SOURCES, *SCRIPTS, *INTERFACES)
            if not all(line in path.read_text()[:300] for line in lines)] == []


@pytest.mark.parametrize('name', EXECUTABLES)
def test_executable_is_installed(name, executables):
    assert os.access(executables / name, os.X_OK), f'{name} is missing: run script/setup'
    (entry_point,) = importlib.metadata.distribution('cliploc_ros').entry_points.select(name=name)
    assert callable(entry_point.load())


def test_installed_package_is_complete(tmp_path):
    """Every module and interface definition of the source is in the installed copy."""
    # Run outside the source tree, whose modules would come first.
    code = 'import cliploc_ros; print(cliploc_ros.__path__[0])'
    installed = Path(run_python(code, cwd=tmp_path).strip())
    for path in [*MODULES, *INTERFACES]:
        copy = installed / path.relative_to(PROJECT / 'cliploc_ros')
        assert copy.is_file(), f'{copy} is missing: run script/setup'
        assert copy.read_bytes() == path.read_bytes(), f'{copy} is stale: run script/setup'


def test_vision_msgs_type_hash_on_the_wire():
    import rclpy
    from vision_msgs.msg import Detection2DArray

    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node('type_hash', context=context)
        node.create_publisher(Detection2DArray, 'detections', 1)
        deadline = time.monotonic() + 10.0
        while not (publishers := node.get_publishers_info_by_topic('detections')):
            assert time.monotonic() < deadline, 'the publisher never appeared'
        assert str(publishers[0].topic_type_hash) == DETECTIONS_TYPE_HASH
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
