# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the commands of the pages in order, from a recorded bag to a pose."""

import importlib
import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from rig_bag import camera_messages, odometry_message, tf_messages, write_messages
from test_doc_commands import PROJECT, commands_in, commands_of, program_of
from without_pytorch import hide_pytorch

from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import layer_path
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.folders import read_sequence
from cliploc_ros.offline.datasets.poses import mount_from_numbers
from demo import ASSETS

FULL = pytest.mark.full
PAGES = [PROJECT / page for page in ('doc/first_relocalization.md', 'README.md',
                                     'doc/your_robot.md', 'doc/mapping.md', 'doc/keyframes.md')]
# Commands for another robot or recording, or for a network that has to be downloaded.
OTHER = {'--cameras', '--update', '--observations', '--colmap', '--queries', '--keyframe-features'}
MOUNT = mount_from_numbers([0.1, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5])
FEW = ('--positions', '2', '--headings', '2', '--frames', '4')
WHOLE = [pytest.param(name, marks=FULL) for name in ('rendered', 'real')]
BOTH = pytest.mark.parametrize('drive', WHOLE, indirect=True)


def write_drive(path, folder, every):
    """Write the bag that doc/your_robot.md records: images, camera_info, odometry and tf."""
    sequence, camera, _ = read_sequence(folder, None)
    sequence, recorded = sequence.every(every), []
    stamps = [stamp for stamp in sequence.stamps_ns if sequence.pose_at(stamp) is not None]
    for stamp, file in zip(sequence.stamps_ns, sequence.image_paths, strict=True):
        pixels = np.ascontiguousarray(cv2.imread(str(file))[..., ::-1])
        for one, topic in zip(camera_messages(stamp, pixels, camera, 'camera_optical_frame'),
                              ('/camera/image_raw', '/camera/camera_info'), strict=True):
            recorded.append((stamp, topic, *one[2:]))
    drive = replace(sequence.trajectory, max_gap_ns=10**10)
    for stamp in sorted({*stamps, *range(stamps[0], stamps[-1], 50_000_000)}):
        odom_from_base = drive.pose_at(stamp) @ invert_transform(MOUNT)
        recorded += tf_messages([(stamp, np.eye(4))], 'map', 'odom')
        recorded += tf_messages([(stamp, odom_from_base)], 'odom', 'base_footprint')
        recorded.append(odometry_message(stamp, odom_from_base))
    write_messages(path, [*recorded, *tf_messages(
        [(sequence.stamps_ns[0], MOUNT)], 'base_footprint', 'camera_optical_frame',
        '/tf_static')])


@pytest.fixture(scope='module')
def drive(request, tmp_path_factory):
    """Return a folder with the bag, and its networks as arguments and as parameters."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == 'short':
        write_drive(folder / 'drive', ASSETS / 'mapping', 3)
        found, more = {'model': ASSETS / 'yolo.onnx'}, ['--no-clip', '--no-check']
    elif request.param == 'rendered':
        write_drive(folder / 'drive', ASSETS / 'mapping', 2)
        found, more = {'model': ASSETS / 'yolo.onnx', 'clip_pretrained': ASSETS / 'clip'}, []
    else:
        shared = request.getfixturevalue('shared_data')
        write_drive(folder / 'drive', shared / 'seven_scenes_kitchen', 2)
        found, more = {'model': shared / 'weights/yolov8n_coco.onnx'}, ['--no-clip']
    arguments = [word for name, file in found.items()
                 for word in (f'--{name.replace("_", "-")}', str(file))]
    return folder, [*arguments, *more], found


@pytest.fixture(scope='module')
def built(drive, tmp_path_factory):
    """Return the drive, and the output of the page's first command; PyTorch cannot be imported."""
    folder, networks, _ = drive
    done = subprocess.run(
        [sys.executable, '-m', 'cliploc_ros.cli.build_map', '--bag', 'drive', '--out',
         'office.yaml', *networks], cwd=folder, capture_output=True, text=True, check=False,
        timeout=600.0, env=hide_pytorch(tmp_path_factory.mktemp('hidden')))
    assert done.returncode == 0, done.stderr
    return *drive, done.stdout


def main_of(name):
    return importlib.import_module(f'cliploc_ros.cli.{name}').main


def documented(pages):
    """Return the commands that make, check or open the map of a drive, without duplicates."""
    found = []
    for page in pages:
        for command in commands_of(page):
            module, arguments = program_of(command)
            name = module.rpartition('.')[2]
            if (name in ('build_map', 'check_map', 'studio') and not OTHER & {*arguments}
                    and ('drive' in arguments or (name != 'build_map'
                                                  and 'office.yaml' in arguments[:1]))):
                found.append((name, *arguments))
    return list(dict.fromkeys(found))


FIRST, *ON_PAGE = documented(PAGES[:1])
ELSEWHERE = [command for command in documented(PAGES) if command not in (FIRST, *ON_PAGE)]


@pytest.mark.parametrize('drive', [
    pytest.param('short', marks=pytest.mark.brief), *WHOLE], indirect=True)
def test_one_command_leads_from_a_bag_to_a_checked_map(built):
    folder, networks, _, printed = built
    assert FIRST == ('build_map', '--bag', 'drive', '--out', 'office.yaml')
    assert printed.endswith('to correct it: studio office.yaml\n')
    assert layer_path(folder / 'office.yaml').exists()
    if '--no-check' in networks:
        return
    checked = json.loads((folder / 'office_check/check.json').read_text())
    end = printed[printed.index('wrote office.yaml'):].splitlines()
    assert len(end) <= 8 and end[1].startswith(f'verdict: {checked["verdict"]}: ')
    recording = checked['recording']
    alone = sum(trial['by_objects'] for trial in recording['trials'])
    assert recording['verdicts']['accepted'] > alone and recording['verdicts']['misled'] == 0


@BOTH
def test_the_other_commands_run(built, monkeypatch):
    """Test all commands in one test, so that pytest makes each map once."""
    folder, networks, _, _ = built
    monkeypatch.chdir(folder)
    for name, *arguments in (*ON_PAGE, *(() if '--no-clip' in networks else ELSEWHERE)):
        if name == 'studio':
            studio = open_studio(make_parser().parse_args(arguments))
            assert studio.views > 10 and studio.document.landmarks
            assert ' deg; by ' in studio.relocalize_here()
            studio.document.close()
        elif name == 'check_map':
            assert main_of(name)([*arguments, *FEW]) in (0, 1), arguments
        else:
            arguments[arguments.index('office.yaml')] = 'other.yaml'
            assert main_of(name)([*arguments, *networks, '--no-check']) == 0, arguments
            assert layer_path('other.yaml').exists() != ('--no-keyframe-layer' in arguments)


@BOTH
def test_the_nodes_answer_as_the_page_says(built, monkeypatch):
    """The robot of the recording drives, with odometry."""
    folder, _, parameters, _ = built
    monkeypatch.chdir(folder)
    walk('## 4. The pose', {
        'detector': {'model': parameters['model']},
        'relocalizer': {'clip_pretrained': parameters['clip_pretrained']}
        if 'clip_pretrained' in parameters else {'matching': 'class'}})


@FULL
def test_the_nodes_answer_in_the_demos_room(tmp_path, monkeypatch):
    shutil.copytree(ASSETS, tmp_path / 'room')
    monkeypatch.chdir(tmp_path)
    walk('## Without a recording')


def walk(section, networks=MappingProxyType({})):
    """Run the documented commands from a bag to a pose; `networks` are parameters of the nodes."""
    text = PAGES[0].read_text().split(f'\n{section}')[1].split('\n## ')[0]
    processes = []
    try:
        for command in commands_in(text, section):
            module, arguments = program_of(command)
            name = module.rpartition('.')[2]
            words = [sys.executable, '-m', module, *arguments, *(
                word for key, value in networks.get(name, {}).items()
                for word in ('-p', f'{key}:={value}'))]
            if name in ('replay', 'detector', 'relocalizer'):
                processes.append(subprocess.Popen(words))
            elif name == 'tum_to_bag':
                subprocess.run(words, check=True)
            elif name == 'wake_up':
                done = subprocess.run(words, capture_output=True, text=True, timeout=300)
                assert done.returncode == 0, done.stdout + done.stderr
                assert re.search(r'^look \d+ .*: accepted: .*; by .*; [0-9.]+ s\n$', done.stdout,
                                 re.MULTILINE)
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            process.wait(60)


@FULL
def test_the_demos_room_gives_the_figures_of_the_page(tmp_path, monkeypatch, capsys):
    """The section for readers without a recording, with the files that it copies."""
    section = ' '.join(PAGES[0].read_text().split('\n## Without a recording')[1].split())
    images, limit_m, accepted, landmarks = map(float, re.search(
        r'All (\d+) poses are within (\.\d+) m .* (\d+) are accepted, .* map has (\d+) landmarks',
        section).groups())
    shutil.copytree(ASSETS, tmp_path / 'room')
    monkeypatch.chdir(tmp_path)
    for command in commands_of(PAGES[0]):
        module, arguments = program_of(command)
        if module and 'room/yolo.onnx' in arguments:
            name = module.rpartition('.')[2]
            # the map is checked above; a process of its own would import everything again
            more = {'build_map': ['--no-check'], 'evaluate': ['--workers', '1']}.get(name, [])
            assert main_of(name)([*arguments, *more]) == 0, capsys.readouterr().err
    results = json.loads(Path('room/result/results.json').read_text())
    assert len(results) == images
    assert max(result['error_m'] for result in results) < limit_m
    assert sum(result['accepted'] for result in results) == accepted
    assert abs(len(LandmarkMap.from_file('room/built.yaml')) - landmarks) <= 2
