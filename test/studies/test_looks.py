# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robots that look again gain recall, and get few further chances of a false accept."""

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.trials import make_queries
from studies.acceptance.looks import LOOKS, Answer, growth_tables, retry
from studies.acceptance.troubles import exchange_landmarks

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def office(shared_data):
    """The real map and every eighth of its main queries."""
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    recorded = load_queries(folder / 'queries.npz', landmark_map.landmark_ids)
    return landmark_map, make_queries(recorded, landmark_map)[::8]


def test_agreement_prevents_false_accepts_in_another_place(office):
    """Every pose is wrong there, and these robots accept what is likelier than not."""
    landmark_map, queries = office
    elsewhere, _ = exchange_landmarks(landmark_map, queries, 1.0, np.random.default_rng(5))
    robots = list(retry(elsewhere, queries, RelocalizerOptions(min_confidence=0.5)))
    alone = sum(one.alone.any() for one in robots)
    together = sum(one.accepted.any() for one in robots)
    print(f'\n{alone} of {len(robots)} robots accept one of {LOOKS} looks alone, {together} '
          'accept looks that agree')
    assert alone > 0
    assert together < alone / 2
    assert not any((one.accepted & ~one.alone).any() for one in robots)


def test_retries_gain_recall(office):
    landmark_map, queries = office
    robots = list(retry(landmark_map, queries, RelocalizerOptions()))
    first = sum(one.accepted[0] for one in robots)
    late = sum(one.accepted.any() for one in robots)
    print(f'\nof {len(robots)} robots {first} accept the first look, {late} one of {LOOKS}')
    assert late > first
    assert not any(one.first_error_m > 1.0 for one in robots)


def test_each_number_of_images_has_its_own_figures():
    grows = [Answer(n, 0.15 * n + 0.2, 0.1, n > 3) for n in range(1, 6)]
    wrong = [Answer(n, 0.1, 5.0, n == 5) for n in range(1, 6)]
    cut_short = [Answer(1, 0.9, 0.1, True)]
    lines = growth_tables([grows, wrong, cut_short]).splitlines()
    assert lines[2].split(' | ')[1:6] == ['1 of 2', '0.225', '0.350', '0.100', '']
    assert lines[6].split(' | ')[1:6] == ['1 of 2', '0.525', '0.950', '0.100', '1.000']
    assert '2, 1 | 1.000' in lines[6]
    of_bins = [line for line in lines if line.startswith('| 0.95')]
    assert of_bins[0].count('1 of 1') == 1
    assert lines[-1].endswith('| 1, 1 |')
