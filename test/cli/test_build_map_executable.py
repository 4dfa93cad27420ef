# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable build_map."""

import json
from functools import partial

import pytest

from cliploc_ros.cli.build_map import main
from cliploc_ros.core.map.landmark_map import LandmarkMap


@pytest.fixture
def build_map(run_here):
    return partial(run_here, main, '--no-check')


def test_builds_a_map_and_a_report(build_map, observations, tmp_path):
    out, report = tmp_path / 'office.yaml', tmp_path / 'office.json'
    old_layer = tmp_path / 'office.keyframes.npz'
    old_layer.touch()
    done = build_map('--observations', observations, '--out', out, '--report', report,
                     '--frame-id', 'world')
    assert done.returncode == 0, done.stderr
    assert not old_layer.exists() and f'removed {old_layer}' in done.stdout
    built = LandmarkMap.from_file(out)
    assert built.frame_id == 'world'
    assert len(built) > 30
    assert all(details.support >= 3 for details in built.details)
    found = json.loads(report.read_text())
    assert found['landmarks'] == len(built)
    assert found['explained'] > 0.85
    assert f'{len(built)} landmarks' in done.stdout and ' 162 frames' in done.stdout
    assert 'left out:' in done.stdout
    assert f'wrote {out}' in done.stdout


def test_an_existing_map_stays_when_building_fails(build_map, observations, tmp_path):
    old = tmp_path / 'old.yaml'
    old.write_text('precious')
    cut = tmp_path / 'cut.npz'
    cut.write_bytes(observations.read_bytes()[:20_000])
    done = build_map('--observations', cut, '--out', old)
    assert done.returncode == 1
    assert done.stderr.startswith(f'error: {cut}: ')
    done = build_map('--observations', observations, '--out', old, '--every', 400)
    assert done.returncode == 1
    assert 'at least 3 ' in done.stderr
    report = tmp_path / 'failed.json'
    done = build_map('--observations', observations, '--out', old, '--min-baseline', 179,
                     '--report', report)
    assert done.returncode == 1 and f'report: {report}' in done.stdout
    found = json.loads(report.read_text())
    assert found['failure'] in done.stderr and len(found['left_out']) > 9
    assert old.read_text() == 'precious'
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'cut.npz', 'failed.json', 'old.yaml']
