# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`doctor --prepare` leaves all that nodes need on a machine without network and PyTorch."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from disks import allowed
from processes import PROJECT
from without_pytorch import hide_pytorch

from demo import ASSETS

pytestmark = pytest.mark.full

# A separate network: the loopback interface and no route.
OFFLINE = ('unshare', '--map-root-user', '--net', 'sh', '-c', 'ip link set lo up && exec "$@"',
           'sh')
# Mounts a folder on itself read-only, as a fleet's robot mounts a shared cache.
READ_ONLY = ('unshare', '--mount', 'sh', '-c',
             'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"')
WEIGHTS = ('yolo.onnx', 'clip')
ROBOT = f"""\
detector:
  ros__parameters:
    model: {ASSETS}/yolo.onnx
relocalizer:
  ros__parameters:
    map_file: {ASSETS}/map.yaml
    clip_pretrained: {ASSETS}/clip
    require_localizer: false
    time_budget_ms: 10000.0  # the verdict must not depend on the load of this machine
"""


@pytest.fixture(scope='module')
def offline():
    return allowed([*OFFLINE])


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    folder = tmp_path_factory.mktemp('robot')
    text = ROBOT
    for name in WEIGHTS:  # without the converted networks beside them
        (folder / name).symlink_to(ASSETS / name)
        text = text.replace(f'{ASSETS}/{name}', f'{folder}/{name}')
    (folder / 'robot.yaml').write_text(text)
    return folder / 'robot.yaml'


def prepare(*arguments, within=(), **environment):
    variables = {name: value for name, value in os.environ.items() if name != 'NUMBA_CACHE_DIR'}
    return subprocess.run(
        [*within, sys.executable, '-m', 'cliploc_ros.cli.doctor', '--prepare',
         *map(str, arguments)],
        cwd=PROJECT, capture_output=True, text=True, timeout=300, check=False,
        env=variables | environment)


@pytest.fixture(scope='module')
def prepared(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp('prepared') / 'carry'
    done = prepare('--params-file', robot, '--cache-dir', folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def content(folder):
    return sorted(str(file.relative_to(folder)) for file in folder.rglob('*'))


def test_it_shows_costs_and_what_to_copy(prepared, robot):
    folder, output = prepared
    assert [line.split()[:2] for line in output.splitlines()][:6] == [
        ['detector', 'pass'], ['relocalizer', 'pass'], ['request', 'pass'], ['cache', 'pass'],
        ['copy', str(folder)], ['copy', 'this']]
    assert re.search(r'first detection \d+ ms, search \d+ ms, CLIP \d+ ms .*; later ', output)
    for file in (*map(robot.with_name, WEIGHTS), Path(ASSETS) / 'map.yaml'):
        assert f'copy this file, too, as a parameter names it: {file}' in output
    assert len(list((folder / 'openvino').iterdir())) == 3


def test_the_folder_is_all_that_the_nodes_need_without_a_network_and_read_only(
        prepared, robot, offline, tmp_path):
    carried = Path(shutil.copytree(prepared[0], tmp_path / 'carried'))
    before = content(carried)
    assert any('kernels/' in name for name in before)
    assert any('labels/' in name for name in before)
    variables = {name: value for name, value in os.environ.items()
                 if name not in ('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME')}
    hidden = hide_pytorch(tmp_path)['PYTHONPATH']
    done = subprocess.run(
        [*offline, *READ_ONLY, str(carried), sys.executable,
         str(Path(__file__).with_name('offline.py')), str(tmp_path),
         '--ros-args', '--params-file', str(robot), '-p', f'cache_dir:={carried}'],
        env=variables | {'PYTHONPATH': f'{hidden}:{PROJECT}/test',
                         'HOME': str(tmp_path / 'home'), 'ROS_LOG_DIR': str(tmp_path)},
        capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('True accepted: x '), done.stdout
    log = (tmp_path / 'relocalizer.log').read_text()
    assert 'labels cached' in log and 'compiling' not in log and 'Read-only' not in log
    assert content(carried) == before, 'a node had to compute or fetch what the folder lacked'


@pytest.mark.parametrize(('lost', 'named'), [
    ('kernels/*_project_all*', 'cannot keep compiled kernels in'), ('openvino/*', '')])
def test_a_folder_that_does_not_take_it_all_is_not_ready(prepared, robot, tmp_path, lost, named):
    """A read-only folder lacks one kernel, or the networks."""
    carried = Path(shutil.copytree(prepared[0], tmp_path / 'carry'))
    for path in carried.glob(lost):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    done = prepare('--params-file', robot, '--cache-dir', carried,
                   within=(*READ_ONLY, str(carried)))
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert re.search(f'^cache +fail +not ready: .*{named}.*{tmp_path}', done.stdout, re.MULTILINE)
    assert 'copy ' not in done.stdout


def test_nothing_is_promised_after_a_failure(robot, tmp_path):
    broken = tmp_path / 'robot.yaml'
    broken.write_text(robot.read_text().replace('yolo.onnx', 'nowhere.onnx'))
    output = prepare('--params-file', broken, '--cache-dir', tmp_path / 'carry').stdout
    assert re.search('^detector +fail ', output) and re.search('\ncache +not checked ', output)
    assert 'neither network' not in output and 'copy ' not in output
