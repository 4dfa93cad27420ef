# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's table on recorded queries, against test/thresholds.yaml."""

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer

LIMITS_M = (0.25, 0.5, 1.0)
METHODS = ('class_bf', 'class_ransac', 'clip_bf', 'clip_b-prosac', 'hybrid_bf', 'hybrid_ransac',
           'hybrid_prosac', 'hybrid_b-prosac')


def success_rates(landmark_map, frames, observe, options):
    relocalizer = Relocalizer(landmark_map, options)
    found = [(relocalizer.relocalize([observe(frame)]), frame.map_from_camera)
             for frame in frames]
    errors = [pose_error(result.map_from_camera, truth)[0] if result.solved else np.inf
              for result, truth in found]
    return [np.mean(np.array(errors) < limit) for limit in LIMITS_M]


@pytest.mark.parametrize('method', METHODS)
def test_success_rates(method, office_map, queries, observe, thresholds):
    matching, algorithm = method.split('_')
    seeds = (0,) if algorithm == 'bf' else range(5)
    rates = np.mean([success_rates(
        office_map, queries.main_frames(), observe,
        RelocalizerOptions(matching=matching, algorithm=algorithm, random_seed=seed,
                           iterations=500, refine=False))
        for seed in seeds], axis=0)
    print(f'\n{method}: success {" / ".join(f"{rate:.2f}" for rate in rates)} at '
          '0.25 / 0.5 / 1 m')
    table = thresholds['table']
    tolerance = table['tolerance']['bf' if algorithm == 'bf' else 'sampled']
    assert rates == pytest.approx(table['success'][method], abs=tolerance)
