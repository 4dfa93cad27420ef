# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The append-only log: cut off, damaged, in use, on a full disk."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from disks import small_disk

from cliploc_ros.errors import DatasetError
from cliploc_ros.files.log import Log

PROJECT = Path(__file__).resolve().parents[2]


def open_log(path):
    return closing(Log(path, DatasetError, 'make room'))


def read(path):
    with open_log(path) as log:
        return log.read()


def write(path, *entries):
    with open_log(path) as log:
        log.read()
        for entry in entries:
            log.append(entry)
    return read(path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'log'


def test_entries_survive(path):
    assert read(path) == ([], False)
    assert write(path, {'one': 1}, []) == ([{'one': 1}, []], False)
    assert write(path, 'three') == ([{'one': 1}, [], 'three'], False)


@pytest.mark.parametrize('lost', range(1, 9))
def test_an_entry_that_was_cut_off_is_replaced(path, lost):
    write(path, 'one', 'second')
    path.write_bytes(path.read_bytes()[:-lost])
    assert read(path) == (['one'], False)
    assert write(path, 'three') == (['one', 'three'], False)


@pytest.mark.parametrize('line', [b'rubbish\n', b'\xff\xfe\n', b'[' * 100_000 + b'\n', b'\n'])
def test_a_damaged_line_ends_the_entries(path, line):
    write(path, 'one', 'second')
    path.write_bytes(path.read_bytes().replace(b'"second"\n', line + b'"third"\n'))
    assert read(path) == (['one'], True)
    with open_log(path) as log:
        aside = log.set_aside()
        assert log.set_aside() != aside
    assert aside.read_bytes().endswith(line + b'"third"\n')
    assert write(path, 'four') == (['one', 'four'], False)


def test_restart_and_remove(path):
    write(path, 'one', 'second')
    with open_log(path) as log:
        log.restart(['other'])
        assert log.read() == (['other'], False)
        log.remove()
    assert not path.exists()


def test_one_process_at_a_time(path):
    with open_log(path), pytest.raises(DatasetError, match='has it open'):
        open_log(path)
    assert read(path) == ([], False)


def test_a_full_disk(path, tmp_path):
    code = ('import sys; from pathlib import Path; from cliploc_ros.files.log import Log\n'
            'from cliploc_ros.errors import DatasetError\n'
            f'log = Log(Path({str(path)!r}), DatasetError, "make room")\n'
            'try:\n'
            '    for _ in range(100):\n'
            '        log.append("x" * 5000)\n'
            'except DatasetError as error:\n'
            '    print(error)\n'
            'entries, is_damaged = log.read()\n'
            'print(len(entries), is_damaged)\n')
    done = subprocess.run([*small_disk(tmp_path), sys.executable, '-c', code], cwd=PROJECT,
                          capture_output=True, text=True, timeout=60, check=True)
    message, kept = done.stdout.splitlines()
    assert 'No space left' in message
    assert 8 <= int(kept.split()[0]) <= 13 and kept.endswith('False')
