# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A request that CLIP cannot complete in time: ViT-B-32 with random weights and 400 crops.

The similarities mean nothing, and no pose reaches a confidence of 1.
"""

import re
import time

import numpy as np
import open_clip
import pytest
import torch
from scene import CAMERA
from tester import make_frame

from cliploc_ros.core.observation import Detections

pytestmark = pytest.mark.full

# ViT-B-32 takes at least 20 s for these crops.
BOXES, TIMEOUT_S = 400, 6.0
# Time for the answer to arrive on a busy machine.
LATE_S = 0.5


@pytest.fixture(scope='module')
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('clip') / 'vit_b_32.pt'
    torch.save(open_clip.create_model('ViT-B-32').state_dict(), path)
    return path


@pytest.fixture
def slow(own_relocalizer, tester, weights, tmp_path):
    """Return a relocalizer that accepts no pose, and for which 400 crops take too long."""
    return own_relocalizer(
        matching='hybrid', algorithm='auto', min_confidence=1.0, clip_model='ViT-B-32',
        clip_pretrained=weights, cache_dir=tmp_path, timeout_s=TIMEOUT_S,
        max_detections=BOXES)


def crowded_frame(number):
    """Return boxes of the room's classes, side by side in one image."""
    left, top = map(np.ravel, np.meshgrid(np.arange(20) * 32.0, np.arange(20) * 24.0))
    boxes = np.stack([left, top, left + 30.0, top + 22.0], axis=1)
    assert len(boxes) == BOXES and boxes.max() <= CAMERA.width
    seen = Detections(boxes, tuple('abc'[row % 3] for row in range(BOXES)), np.full(BOXES, 0.9))
    return make_frame(seen, stamp_s=100.0 + number)


def test_the_answer_is_in_time_and_names_what_used_it_up(slow, tester):
    frame, counts = crowded_frame(0), []
    for _ in range(2):
        start = time.monotonic()
        answer = tester.relocalize(frame)
        took_s = time.monotonic() - start
        print(f'\nafter {took_s:.2f} s: {answer.message}')
        assert not answer.success and answer.message.startswith('refused: ')
        assert re.search(r'time is up: CLIP took [\d.]+ of [\d.]+ s; choose a faster profile or a '
                         r'smaller CLIP, or raise timeout_s', answer.message)
        assert took_s < TIMEOUT_S + LATE_S
        # similarities are missing if a batch took longer than the previous one, beyond the time-
        # out
        counts += map(int, re.findall(rf'CLIP of (\d+) of {BOXES} crops', answer.message))
    assert all(0 < count < BOXES for count in counts)
    # crops encoded for the first request are not encoded again for the second
    assert len(counts) < 2 or counts[1] > counts[0]
