# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable check_map, as a user starts it."""

import json
import subprocess
import sys


def check_map(*args):
    return subprocess.run([sys.executable, '-m', 'cliploc_ros.cli.check_map', *map(str, args)],
                          capture_output=True, text=True, timeout=300)


def test_a_good_map_passes(shared_data, tmp_path):
    office = shared_data / 'tum_fr3_office'
    done = check_map(office / 'map.yaml', '--observations', office / 'observations.npz',
                     '--json', tmp_path / 'check.json', '--html', tmp_path / 'check.html')
    assert done.returncode == 0, done.stdout + done.stderr
    checked = json.loads((tmp_path / 'check.json').read_text())
    assert len(checked['landmarks']) == 40
    assert checked['explained'] > 0.85
    assert (tmp_path / 'check.html').read_text().startswith('<!doctype html>')
    assert '40 landmarks' in done.stdout


def test_a_doubled_map_fails(shared_data, tmp_path):
    text = (shared_data / 'tum_fr3_office' / 'map.yaml').read_text()
    head, landmarks = text.split('      landmarks:\n')
    doubled = landmarks.replace('_1:\n', '_1b:\n').replace('_2:\n', '_2b:\n')
    for number in range(3, 20):
        doubled = doubled.replace(f'_{number}:\n', f'_{number}b:\n')
    path = tmp_path / 'doubled.yaml'
    path.write_text(f'{head}      landmarks:\n{landmarks}{doubled}')
    done = check_map(path)
    assert done.returncode == 1
    assert 'below threshold: ' in done.stdout
    assert 'doubles cause false accepts' in done.stdout


def test_what_cannot_be_read_is_named(tmp_path):
    done = check_map(tmp_path / 'missing.yaml')
    assert done.returncode == 1
    assert done.stderr.startswith('error: ')
    assert 'Traceback' not in done.stderr
