# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Partial results on disk: cut off, of another run, on a full disk."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from disks import small_disk

from cliploc_ros.errors import DatasetError, OptionsError
from cliploc_ros.recording.journal import Journal
from cliploc_ros.recording.recorder import EVERY_FRAME, KeyframeFilter, KeyframeOptions

PROJECT = Path(__file__).resolve().parents[2]


def write(path, *chunks, run=b'run'):
    with Journal(path, run) as journal:
        for chunk in chunks:
            journal.add(chunk)
        return list(journal.chunks())


def test_chunks_survive(tmp_path):
    path = tmp_path / 'journal'
    assert write(path, b'one', b'') == [b'one', b'']
    assert write(path, b'three') == [b'one', b'', b'three']


@pytest.mark.parametrize('lost', range(1, 12))
def test_a_cut_off_chunk_is_dropped(tmp_path, lost):
    path = tmp_path / 'journal'
    write(path, b'one', b'second')
    path.write_bytes(path.read_bytes()[:-lost])
    assert write(path, b'three') == [b'one', b'three']


def test_a_damaged_chunk_ends_the_file(tmp_path):
    path = tmp_path / 'journal'
    write(path, b'one', b'second', b'third')
    path.write_bytes(path.read_bytes().replace(b'second', b'sec0nd'))
    assert write(path) == [b'one']


@pytest.mark.parametrize('content', [b'', b'rubbish of another program', bytes(100)])
def test_another_run_is_thrown_away(tmp_path, content):
    path = tmp_path / 'journal'
    path.write_bytes(content)
    assert write(path, b'one') == [b'one']
    assert write(path, b'two', run=b'another') == [b'two']


def test_a_full_disk(tmp_path):
    code = ('import sys; from pathlib import Path; from cliploc_ros.recording.journal import '
            'Journal\n'
            'from cliploc_ros.errors import DatasetError\n'
            f'path = Path({str(tmp_path)!r}) / "journal"\n'
            'try:\n'
            '    with Journal(path, b"run") as journal:\n'
            '        for _ in range(100):\n'
            '            journal.add(bytes(5000))\n'
            'except DatasetError as error:\n'
            '    print(error)\n'
            'with Journal(path, b"run") as journal:\n'
            '    print(len(list(journal.chunks())))\n')
    done = subprocess.run([*small_disk(tmp_path), sys.executable, '-c', code], cwd=PROJECT,
                          capture_output=True, text=True, timeout=60, check=True)
    message, kept = done.stdout.splitlines()
    assert 'No space left on device' in message and '--record-to' in message
    assert 8 <= int(kept) <= 13


def test_a_missing_folder(tmp_path):
    with pytest.raises(DatasetError, match=r'none/journal: cannot be written: No such file'):
        write(tmp_path / 'none/journal')


def pose(x=0.0, turn_deg=0.0):
    turn = np.radians(turn_deg)
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    transform[0, 3] = x
    return transform


def test_keyframes_by_distance_angle_and_pose():
    is_keyframe = KeyframeFilter(KeyframeOptions(0.1, 5.0))
    walk = [None, pose(), pose(0.06), pose(0.11), None, pose(0.11, 4.0), pose(0.11, 6.0),
            pose(0.205, 6.0), pose(0.215, 6.0)]
    assert [is_keyframe(place, place, one) for place, one in enumerate(walk)] == [
        False, True, False, True, False, False, True, False, True]
    assert (is_keyframe.asked, is_keyframe.without_pose, is_keyframe.keyframes) == (9, 2, 4)


def test_every_frame():
    is_keyframe = KeyframeFilter(EVERY_FRAME)
    assert [is_keyframe(0, 0, one) for one in (pose(), pose(), None)] == [True, True, False]


def test_impossible_keyframes():
    with pytest.raises(OptionsError, match='give 0 or more'):
        KeyframeOptions(-0.1, 5.0)
