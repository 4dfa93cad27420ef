# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The package: imports point downwards; licence lines, executables and interfaces are there."""

import ast
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
import yaml

PROJECT = Path(__file__).resolve().parents[1]
ROOT = 'cliploc_ros'
MODULES = {'.'.join(path.relative_to(PROJECT).with_suffix('').parts).removesuffix('.__init__'):
           path for path in sorted((PROJECT / ROOT).rglob('*.py'))}

LAYERS = yaml.safe_load((PROJECT / 'test/layers.yaml').read_text())
RANKS = {f'{ROOT}.{prefix}': rank for rank, prefixes in enumerate(LAYERS) for prefix in prefixes}


def prefix_of(module: str) -> str:
    """Return the longest prefix of a layer that a module belongs to."""
    prefix = module
    while prefix not in RANKS:
        prefix, dot, _ = prefix.rpartition('.')
        assert dot, f'{module} is in no layer: add it to test/layers.yaml'
    return prefix


@cache
def imported_modules(path: Path) -> set[str]:
    """Return the modules that a file imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f'{path}:{node.lineno}: import relative to the package'
            submodules = {f'{node.module}.{alias.name}' for alias in node.names}
            found |= submodules & MODULES.keys() or {node.module}
    return found


def test_no_imports_form_a_circle():
    TopologicalSorter({module: (imported_modules(path) & MODULES.keys()) - {module}
                       for module, path in MODULES.items()}).prepare()  # raises CycleError


def test_imports_point_downwards():
    upward = []
    for module in sorted(MODULES.keys() - {ROOT}):
        here = prefix_of(module)
        for imported in sorted(imported_modules(MODULES[module]) & MODULES.keys() - {ROOT}):
            there = prefix_of(imported)
            if there != here and RANKS[there] >= RANKS[here]:
                upward.append(f'{module} ({here}) imports {imported} ({there})')
    assert not upward, '\n' + '\n'.join(upward)


#: Greatest number of the package's modules that the import of a node loads, which limits what a
#: reader needs.
MOST_LOADED = 100


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_a_node_loads_few_modules(node):
    assert int(run_python(
        f'import sys, cliploc_ros.nodes.{node}\n'
        f'print(sum(name.startswith({ROOT!r}) for name in sys.modules))', PROJECT)) <= MOST_LOADED


#: Names that several classes still share.
SHARED_NAMES = {
    'Camera', 'Evidence', 'Fit', 'Groups', 'Keyframes', 'Known', 'Look', 'Place', 'Poses',
    'Record', 'Sample', 'State', 'Turn', 'Views'}


def test_a_class_name_leads_to_one_definition():
    names = [node.name.lstrip('_') for path in MODULES.values()
             for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)]
    assert {name for name in names if names.count(name) > 1} <= SHARED_NAMES


# ---- files and executables ----------------------------------------------------------------------
SOURCES = [*MODULES.values(), PROJECT / 'setup.py', *(
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


def test_every_ros_package_that_is_imported_is_declared():
    sources = [*MODULES.values(), *(PROJECT / 'launch').glob('*.py')]
    used = {name for path in sources
            for name in (module.partition('.')[0] for module in imported_modules(path))
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
    for path in [*MODULES.values(), *INTERFACES]:
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
