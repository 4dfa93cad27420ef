# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a fit finds what data were made from, and whether shipped confidences are true."""


import numpy as np
import pytest

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    confidences,
    none_right,
    utilities,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.observations import load_queries
from cliploc_ros.offline.evaluation.figures import within_ellipsoid
from cliploc_ros.offline.evaluation.methods import Method
from cliploc_ros.offline.evaluation.run import run_methods
from cliploc_ros.offline.evaluation.trials import make_queries
from studies.acceptance.fit import Case, fit, judge, outcomes

pytestmark = pytest.mark.full

# a fit begins at the installed influence of the map's size and the vertical
INSTALLED = CALIBRATION.objects
MADE_FROM = INSTALLED._replace(none_right=3.0, map_size=0.8, vertical=-1.0, slope=0.0)
MADE_BY = CALIBRATION._replace(objects=MADE_FROM)


def make_cases(rng, count):
    """Frames of up to four hypotheses; one of them, or none, is right as the model has it.

    Maps of 40 to 400 landmarks; every other frame knows the vertical.
    """
    cases = []
    for number in range(count):
        some = int(rng.integers(1, 5))
        supports = tuple(Support(int(rng.integers(3, 9)), *rng.uniform((0, 4, 0, 0),
                                                                       (4, 30, 15, 12)),
                                 0.0, float(rng.integers(0, 4)))
                         for _ in range(some))
        setting = Setting(int(rng.integers(40, 401)), (np.inf, 1.0)[number % 2])
        poses = np.tile(np.eye(4), (some, 1, 1))
        poses[:, 0, 3] = 5.0 * np.arange(some)
        chances = confidences(utilities(supports, MADE_BY), poses,
                              none_right(setting, MADE_BY), MADE_BY)
        right = np.zeros(some, dtype=bool)
        chosen = int(np.searchsorted(np.cumsum(chances), rng.random()))
        right[chosen:chosen + 1] = True
        cases.append(Case(supports, poses, right, np.zeros(some), setting))
    return cases


def test_a_fit_finds_what_the_data_were_made_from():
    cases = make_cases(np.random.default_rng(0), 3000)
    calibration = fit(cases[:2000])
    found = calibration.objects
    assert found.score == pytest.approx(MADE_FROM.score, rel=0.15)
    assert found.likeness == pytest.approx(MADE_FROM.likeness, rel=0.15)
    assert found.misfit == pytest.approx(MADE_FROM.misfit, rel=0.15)
    assert found.unexplained == pytest.approx(MADE_FROM.unexplained, rel=0.15)
    assert found.rarity == pytest.approx(MADE_FROM.rarity, rel=0.15)
    assert found.map_size == pytest.approx(MADE_FROM.map_size, rel=0.3)
    assert found.vertical == pytest.approx(MADE_FROM.vertical, rel=0.3)
    assert found.slope < 0.5
    likely, right = outcomes(cases[2000:], calibration)
    for low, high in ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0)):
        chosen = (likely >= low) & (likely <= high)
        assert right[chosen].mean() == pytest.approx(likely[chosen].mean(), abs=0.07)


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    return landmark_map, load_queries(folder / 'queries.npz', landmark_map.landmark_ids)


def test_confidences_are_true_where_nothing_was_fitted(office):
    landmark_map, recorded = office
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    found = [judge(relocalizer.relocalize([query.observation]), query.map_from_camera,
                   Setting(len(landmark_map)))
             for query in make_queries(recorded, landmark_map, True)[::2]]
    likely, right = outcomes([one for one in found if len(one.supports)])
    accepted = likely >= 0.9
    print(f'\naccepted {accepted.sum()}, {(accepted & ~right).sum()} of them wrong; of '
          f'{right.sum()} right ones {(accepted & right).sum() / right.sum():.3f} are accepted')
    assert right[accepted].mean() >= 0.99
    assert (accepted & right).sum() / right.sum() >= 0.8
    # confidences are true on average
    assert right[likely > 0.5].mean() == pytest.approx(likely[likely > 0.5].mean(), abs=0.05)


def test_accepted_poses_lie_in_their_ellipsoids(office):
    landmark_map, recorded = office
    results = run_methods(landmark_map, [Method('auto', RelocalizerOptions())],
                          make_queries(recorded, landmark_map), trials=1)
    squares = np.array([one.nees for one in results if one.accepted])
    assert len(squares) > 30
    assert 0.90 <= within_ellipsoid(squares) <= 0.99 + 1 / len(squares)
