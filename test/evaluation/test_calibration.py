# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a fit finds what data were made from, and whether shipped confidences are true."""

import numpy as np
import pytest

from cliploc_ros.core.acceptance.confidence import DEFAULT, Support, confidences
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation import calibration
from cliploc_ros.evaluation.calibration import Case
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.run import run_methods
from cliploc_ros.evaluation.trials import make_queries
from cliploc_ros.evaluation.trust import within_ellipsoid

MADE_FROM = DEFAULT._replace(slope=0.0)


def make_cases(rng, count):
    """Frames of up to four hypotheses; one of them, or none, is right as the model has it."""
    cases = []
    for number in range(count):
        some = int(rng.integers(1, 5))
        supports = tuple(Support(int(rng.integers(3, 9)), *rng.uniform((0, 4, 0), (4, 30, 9)),
                                 float(rng.integers(0, 5)), 0.0, float(rng.integers(0, 4)))
                         for _ in range(some))
        poses = np.tile(np.eye(4), (some, 1, 1))
        poses[:, 0, 3] = 5.0 * np.arange(some)
        chances = confidences(supports, poses, MADE_FROM)
        right = np.zeros(some, dtype=bool)
        chosen = int(np.searchsorted(np.cumsum(chances), rng.random()))
        right[chosen:chosen + 1] = True
        cases.append(Case(str(number // 5), calibration.WHOLE, supports, poses, right,
                          np.zeros(some)))
    return cases


def test_a_fit_finds_what_the_data_were_made_from():
    cases = make_cases(np.random.default_rng(0), 3000)
    found = calibration.fit(cases[:2000])
    assert found.score == pytest.approx(MADE_FROM.score, rel=0.15)
    assert found.likeness == pytest.approx(MADE_FROM.likeness, rel=0.15)
    assert found.misfit == pytest.approx(MADE_FROM.misfit, rel=0.15)
    assert found.unexplained == pytest.approx(MADE_FROM.unexplained, rel=0.15)
    assert found.none_right == pytest.approx(MADE_FROM.none_right, rel=0.15)
    likely = calibration.confidence(cases[2000:], found)
    right = np.array([case.right[0] for case in cases[2000:]])
    for low, high in ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0)):
        chosen = (likely >= low) & (likely <= high)
        assert right[chosen].mean() == pytest.approx(likely[chosen].mean(), abs=0.07)


def test_a_fit_needs_right_and_wrong_poses():
    cases = [case for case in make_cases(np.random.default_rng(1), 50) if case.right[0]]
    with pytest.raises(OptionsError, match='a fit needs right and wrong'):
        calibration.fit(cases)


def test_no_place_is_in_both_halves():
    cases = make_cases(np.random.default_rng(2), 100)
    one, other = calibration.halves(cases)
    assert len(one) == len(other) == 10
    assert not one & other


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    return landmark_map, load_queries(folder / 'queries.npz', landmark_map.landmark_ids)


def test_confidences_of_other_places_are_true(office):
    """Half of the places choose the coefficients, the frames of the other half judge."""
    landmark_map, recorded = office
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    cases = []
    for query, frame in zip(make_queries(recorded, landmark_map, True), recorded, strict=True):
        found = relocalizer.relocalize([query.observation])
        if found.solved:
            cases.append(calibration.judge(found, query.map_from_camera, str(frame.group)))
    judged = calibration.cross_fitted(cases)
    likely, right = (np.concatenate([half[column] for half in judged]) for column in (0, 1))
    accepted = likely >= 0.99
    print(f'\naccepted {accepted.sum()}, {(accepted & ~right).sum()} of them wrong; of '
          f'{right.sum()} right ones {(accepted & right).sum() / right.sum():.3f} are accepted')
    assert right[accepted].mean() >= 0.99
    assert (accepted & right).sum() / right.sum() >= 0.83
    # confidences are true on average
    assert right[likely > 0.5].mean() == pytest.approx(likely[likely > 0.5].mean(), abs=0.05)


def test_accepted_poses_lie_in_their_ellipsoids(office):
    landmark_map, recorded = office
    results = run_methods(landmark_map, [Method('auto', RelocalizerOptions())],
                          make_queries(recorded, landmark_map), trials=1)
    squares = np.array([one.nees for one in results if one.accepted])
    assert len(squares) > 30
    assert 0.90 <= within_ellipsoid(squares) <= 0.99 + 1 / len(squares)
