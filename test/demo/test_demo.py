# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo as a user does, to its end or to Ctrl-C."""

import os
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from disks import small_disk

PROJECT = Path(__file__).resolve().parents[2]

WAKE_UPS = 10  # the demo's default, which the page shows
PAGE = PROJECT / 'doc/first_relocalization.md'
PATIENCE_S = 200.0  # below the time limit of a test
ROW = re.compile(r'^(\d+) .*?(accepted|refused) .*?\(?([0-9.]+) m [0-9.]+°', re.MULTILINE)


def start(*arguments, within=()):
    return subprocess.Popen(
        [*within, sys.executable, '-X', 'faulthandler', '-m', 'demo', *map(str, arguments)],
        text=True, cwd=PROJECT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def run(*arguments, within=()):
    process = start(*arguments, within=within)
    try:
        output, errors = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # it prints the stacks of its threads
        pytest.fail(f'the demo hangs: {process.communicate()}')
    return process.returncode, output, errors


@pytest.fixture(scope='module', params=[
    pytest.param(2, marks=pytest.mark.brief), pytest.param(WAKE_UPS, marks=pytest.mark.full)])
def finished(request, tmp_path_factory):
    """Run the demo to its end; return the folder of its pictures, its output, and its wake-ups."""
    out = tmp_path_factory.mktemp('demo') / 'pictures'
    hurried = () if request.param == WAKE_UPS else ('--wake-ups', request.param, '--rate', 100)
    code, output, errors = run('--out', out, '--rviz', *hurried)
    assert code == 0, errors
    return out, output, request.param


def test_poses_are_right_or_refused(finished):
    _, output, count = finished
    print(output)
    rows = ROW.findall(output)
    errors_m = [float(error) for _, answer, error in rows if answer == 'accepted']
    assert f'{count} wake-ups: {len(errors_m)} accepted' in output
    assert len(errors_m) >= 0.8 * count
    assert max(errors_m) < 0.5
    if count < WAKE_UPS:
        return
    (shown,), (printed,) = (re.findall(r'^\d+ wake-ups: .* at most', text, re.MULTILINE)
                            for text in (PAGE.read_text(), output))
    assert re.sub(r'0\.\d+', '', shown) == re.sub(r'0\.\d+', '', printed)
    errors_m = [[float(error) for error in re.findall(r'0\.\d+', text)]
                for text in (shown, printed)]
    np.testing.assert_allclose(*errors_m, atol=0.1)
    assert abs(errors_m[0][0] - errors_m[1][0]) < 0.02, 'the median'
    assert run_of_page('script/demo') == [10, 10, round(errors_m[0][0], 2)]


def test_the_page_shows_all_pictures_and_says_what_it_does_not(finished):
    out, output, count = finished
    page, pictures = (out / 'index.html').read_text(), sorted(out.glob('*.png'))
    assert [picture.name for picture in pictures] == [
        'top_view.png', *(f'wake_up_{number:02d}.png' for number in range(1, count + 1))]
    pixels = [cv2.imread(str(picture)) for picture in pictures]
    for image, picture in zip(pixels, pictures, strict=True):
        assert min(image.shape[:2]) > 600 and image.std() > 20
        assert f'src="{picture.name}"' in page
    assert all(np.any(first != second) for first, second in pairwise(pixels[1:]))
    assert f'equal in {count} of {count} cases' in page
    assert str(out / 'index.html') in output


def run_of_page(command):
    """Return the numbers in the row of the page about a run of the demo."""
    (row,) = re.findall(rf'^\| `{command}` \| (.*) \|$', PAGE.read_text(), re.MULTILINE)
    return [float(number) for number in re.findall(r'\d*\.?\d+', row)]


@pytest.mark.full
def test_a_disk_that_fills_up_is_named_in_one_line(tmp_path):
    code, _, errors = run('--out', tmp_path, '--wake-ups', 1, '--rate', 100, '--method',
                          'class_ransac', within=small_disk(tmp_path))
    assert code == 1 and 'Traceback' not in errors
    assert re.match(rf'error: {tmp_path}/\S+: cannot be written: No space left .*make room',
                    errors.splitlines()[-1]), errors


@pytest.mark.clock  # a request uses the cameras whose images arrive in time
def test_four_cameras_need_not_turn(tmp_path):
    code, output, errors = run('--out', tmp_path, '--cameras', 4)
    assert code == 0, errors
    print(output)
    accepted, places, *alone = run_of_page('--cameras 4')
    assert f'{places:.0f} wake-ups: {accepted:.0f} accepted, 0 refused, none wrong' in output
    assert any(f'4 cameras; with the first camera alone, {number:.0f} of {places:.0f} would be '
               'accepted' in output for number in alone)
    page = (tmp_path / 'index.html').read_text()
    assert page.count(' in 4 images; ') == places
    assert 'The robot has 4 cameras, front, left, back, right,' in page
    assert 'rank its place' not in page, 'the pictures have no list'
    height, width = cv2.imread(str(tmp_path / 'wake_up_01.png')).shape[:2]
    assert height > 0.7 * width, 'two rows of two images'


@pytest.mark.clock  # a busy machine skips looks
def test_a_kidnapped_robot_is_noticed_stops_and_gets_its_pose_back(tmp_path):
    code, output, errors = run('--out', tmp_path, '--kidnapped', '--method', 'class_auto')
    print(output)
    assert code == 0, errors
    steps = re.findall(r'^ *([0-9.]+) s +(\d+) looks: (\w+(?: \w+)?)', output, re.MULTILINE)
    assert [step for *_, step in steps] == [
        'moved by', 'the watch', 'the robot', 'relocalized', 'delivered', 'the watch']
    seconds = [float(second) for second, *_ in steps]
    assert seconds == sorted(seconds), 'no pose may be delivered before the robot stops'
    moved_m, most_looks, within_m = run_of_page('--kidnapped')
    assert int(steps[1][1]) <= most_looks
    assert float(re.search('delivered: ([0-9.]+) m', output)[1]) < within_m
    assert abs(moved_m - float(re.search(r'moved by ([0-9.]+) m', output)[1])) < 0.1
    assert cv2.imread(str(tmp_path / 'kidnapped.png')).std() > 20


@pytest.mark.full
def test_the_built_map_holds_the_room_and_localizes_as_the_true_one(tmp_path):
    code, output, errors = run('--out', tmp_path / 'mapped', '--map', '--wake-ups', 1, '--rate',
                               100)
    assert code == 0, errors
    print('\n' + output)
    limits = yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['demo']['built_map']
    found, objects, false, offset_cm = map(float, re.search(
        r'^(\d+) of (\d+) objects found, \d+ missed, (\d+) false; centres ([.0-9]+) cm off',
        output, re.MULTILINE).groups())
    assert found / objects >= limits['found']
    assert false <= limits['most_false']
    assert offset_cm / 100 <= limits['center_offset_m']
    on_page = run_of_page('--map')
    assert on_page[1] == objects and abs(on_page[0] - found) <= 1 and abs(on_page[2] - false) <= 1
    success = {name: (float(quarter), int(wrong)) for name, quarter, wrong in re.findall(
        r'^(built|true) map +([.0-9]+) .* (\d+)$', output, re.MULTILINE)}
    assert success['built'][0] >= limits['success_at_a_quarter_metre']
    assert success['true'][0] > 0.9 and success['built'][1] == success['true'][1] == 0
    assert '1 wake-ups: ' in output


def children(pid):
    """Return the children of a process."""
    return [int(child) for child in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


@pytest.mark.full
@pytest.mark.parametrize(('number', 'expected'), [
    (signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)])
def test_no_process_outlives_it(tmp_path, number, expected):
    process = start('--out', tmp_path, '--rate', '0.5', '--method', 'class_ransac')
    for line in process.stdout:
        if line.startswith('both are ready'):
            break
    nodes = children(process.pid)
    assert len(nodes) == 2
    os.kill(process.pid, number)
    process.communicate(timeout=20)
    assert process.returncode == expected
    deadline = time.monotonic() + 10
    while any(Path(f'/proc/{node}').exists() for node in nodes):
        assert time.monotonic() < deadline, 'a node is still running'
        time.sleep(0.05)
