# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot asks once, when it wakes up: the first request is as fast as any other."""

import re
from pathlib import Path

import numpy as np
import pytest
from tester import make_frame

pytestmark = pytest.mark.full

ASSETS = Path(__file__).resolve().parents[2] / 'cliploc_ros/demo/assets'
STAGES = ('decoding', 'CLIP', 'search')
# No pose is that certain, so each request takes all of its crops.
WITH_CLIP = {'matching': 'hybrid', 'algorithm': 'auto', 'clip_model': ASSETS / 'clip.json',
             'clip_pretrained': ASSETS / 'clip.safetensors', 'min_confidence': 1.0}


@pytest.mark.clock
@pytest.mark.parametrize('parameters', [{'algorithm': 'auto'}, WITH_CLIP],
                         ids=['class', 'CLIP'])
def test_the_first_request_is_no_slower(own_relocalizer, tester, parameters, tmp_path):
    own_relocalizer(fresh=True, **parameters, cache_dir=tmp_path)
    times = []
    for number in range(10):
        frame = make_frame(stamp_s=100.0 + number)
        # another picture: crops that have not changed are not encoded again
        frame[0].data = np.roll(frame[0].data, 1000 * number).tobytes()
        message = tester.relocalize(frame).message
        times.append([float(ms) for stage in STAGES
                      for ms in re.findall(rf'{stage} (\d+) ms', message)])
    sums = np.sum(times, axis=1)
    print(f'\ndecoding, CLIP and search: first {sums[0]:.0f} ms {times[0]}, tenth '
          f'{sums[-1]:.0f} ms, median of the later nine {np.median(sums[1:]):.0f} ms')
    # the three stages are rounded to a millisecond each
    assert sums[0] <= 1.5 * np.median(sums[1:]) + 3.0
