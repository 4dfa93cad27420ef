# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests compile nothing: the warm-up calls every kernel with the types of their arguments."""

import subprocess
import sys
from pathlib import Path

import pytest

from cliploc_ros.core.options import ALGORITHMS, MATCHINGS

pytestmark = pytest.mark.full

# In a process of its own: here other tests have called the kernels. It prints how many kernels the
# warm-up brought, and how many each kind of request added.
PROGRAM = """
import sys
sys.path[:0] = sys.argv[1:3]
from dataclasses import replace
import numpy as np
from cliploc_ros.core.kernels.compiled import KERNEL_FOLDERS
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.query import Query
from test_matching import make_world

landmark_map, observation = make_world(60)
Relocalizer(landmark_map, RelocalizerOptions()).warm_up()
before = KERNEL_FOLDERS.found + KERNEL_FOLDERS.missing
print('warm-up', before)
for method in sys.argv[3:]:
    matching, _, algorithm = method.partition('_')
    for up in (None, np.array([0.0, -1.0, 0.0])):
        options = RelocalizerOptions(matching=matching, algorithm=algorithm, iterations=200)
        session = Localizer(Relocalizer(landmark_map, options))
        for number in range(3):
            place = np.eye(4) + 0.1 * number * np.eye(4, k=3)
            session.answer(Query((replace(observation, up_in_camera=up, stamp_ns=number,
                                          odom_from_camera=place),), limit=5, length_s=5.0))
    print(method, KERNEL_FOLDERS.found + KERNEL_FOLDERS.missing - before)
"""


@pytest.fixture(scope='module')
def counts():
    here = Path(__file__).parent
    methods = [f'{matching}_{algorithm}' for matching in MATCHINGS for algorithm in ALGORITHMS
               if matching != 'class' or algorithm in ('auto', 'bf', 'ransac')]
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM, str(here), str(here.parent), *methods],
        capture_output=True, text=True, cwd=here.parents[1], timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return {name: int(count) for name, count in map(str.split, done.stdout.splitlines())}


def test_no_request_compiles_a_kernel(counts):
    assert counts.pop('warm-up') >= 12
    assert {'class_auto', 'clip_prosac', 'hybrid_auto'} < counts.keys()
    assert not any(counts.values()), counts
