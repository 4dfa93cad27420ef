# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable import_map."""

import json
from functools import partial

import numpy as np
import pytest
from foreign_maps import table_text

from cliploc_ros.cli.import_map import main
from cliploc_ros.core.map.landmark_map import LandmarkMap


@pytest.fixture
def import_map(run_here):
    return partial(run_here, main)


@pytest.fixture(scope='module')
def office(shared_data):
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office' / 'map.yaml')


@pytest.fixture(scope='module')
def table(office, tmp_path_factory):
    """Return the office as another system may store it: 5 cm off on each axis, and too large."""
    rng = np.random.default_rng(0)
    text = table_text(LandmarkMap(
        'map', office.landmark_ids, office.labels, office.class_ids,
        office.centers + rng.normal(0.0, 0.05, office.centers.shape), office.semi_axes * 1.3,
        office.quats_xyzw))
    path = tmp_path_factory.mktemp('theirs') / 'theirs.csv'
    path.write_text(text + 'ghost,a cup,cup,0,0,9,.1,.1,.1,0,0,0,1\nthin,,cup,0,0,9,.1,.1,0.0001,'
                    '0,0,0,1\n')
    return path


def test_refits_to_a_recording(import_map, office, table, observations, tmp_path):
    out, report = tmp_path / 'map.yaml', tmp_path / 'map.json'
    done = import_map(table, '--refit', observations, '--out', out,
                      '--report', report, '--frame-id', 'world')
    assert done.returncode == 0, done.stderr
    found = LandmarkMap.from_file(out)
    assert found.frame_id == 'world'
    assert f'{len(found)} of 41 ' in done.stdout
    places = dict(zip(office.landmark_ids, office.centers, strict=True))
    errors_m = [np.linalg.norm(center - places[name])
                for name, center in zip(found.landmark_ids, found.centers, strict=True)]
    print(f'{len(found)} landmarks, median error {np.median(errors_m) * 100:.1f} cm')
    assert len(found) >= 30 and np.median(errors_m) < 0.03
    assert {detail.source for detail in found.details} == {'import_map csv theirs.csv'}
    assert all(detail.support >= 3 and detail.position_sigma < 0.1 and detail.shared_sigma is None
               for detail in found.details)
    left_out = {trial['landmark_id']: trial['reason'] for trial in json.loads(report.read_text())[
        'left_out']}
    assert len(left_out) == 42 - len(found)
    assert 'semi-axes' in left_out['thin'] and 'ghost' in left_out


def test_keeps_what_cannot_be_fitted_where_asked_for(import_map, table, observations, tmp_path):
    out = tmp_path / 'map.yaml'
    done = import_map(table, '--refit', observations, '--out', out,
                      '--keep-unsupported')
    assert done.returncode == 0, done.stderr
    found = LandmarkMap.from_file(out)
    assert found.centers[found.landmark_ids.index('ghost')].tolist() == [0.0, 0.0, 9.0]
    kept = found.details[found.landmark_ids.index('ghost')]
    assert kept.support is None
    assert (kept.position_sigma, kept.shared_sigma, kept.shared_sigma_deg) == (0.05, 0.05, 1.0)
