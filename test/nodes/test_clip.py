# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer with a real CLIP, of random weights: none trained is at hand.

Its similarities mean nothing, so every landmark is made a candidate (k = 12) and the sampler is
given enough samples to find the pose all the same. What is shown is the whole path, not the use
of CLIP.
"""

import re
import time

import open_clip
import pytest
import torch
from rcl_interfaces.srv import GetParameters
from scene import MAP_FROM_CAMERA, make_room, see_room
from tester import class_matching, make_frame, transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Detections

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('clip') / 'vit_b_32.pt'
    torch.save(open_clip.create_model('ViT-B-32').state_dict(), path)
    return path


@pytest.fixture(scope='module')
def cache_dir(tmp_path_factory):
    return tmp_path_factory.mktemp('cache')


@pytest.fixture(scope='module', params=['first start', 'warm cache'])
def clip_relocalizer(request, start_shared, room_map, tester, checkpoint, cache_dir):
    """A relocalizer with CLIP, started twice: the second time its labels are encoded already."""
    process = start_shared('nodes.relocalizer', parameters=class_matching(
        room_map, matching='hybrid', algorithm='b-prosac', k=12, iterations=30000, timeout_s=60.0,
        crops='all', inference='pytorch', clip_model='ViT-B-32', clip_pretrained=checkpoint,
        cache_dir=cache_dir))
    process.wait_for_output('ready after')
    assert ('encoded' if request.param == 'first start' else 'cached') in process.output()
    tester.connect()
    yield process
    process.stop()
    tester.wait(lambda: tester.count_publishers('/relocalizer/pose') == 0, 'its end')


def crowded_frame():
    """A frame with fifty boxes: the room's and many more."""
    seen = see_room(make_room())
    rows = [row % len(seen) for row in range(50)]
    return make_frame(Detections(seen.bboxes_xyxy[rows], tuple(seen.class_ids[r] for r in rows),
                                 seen.scores[rows]), stamp_s=5.0)


def test_crops_lead_to_a_pose(clip_relocalizer, tester):
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: tester.poses, 'a pose')
    assert pose_error(transform_of(tester.poses.pop().pose.pose), MAP_FROM_CAMERA) < (0.05, 1.0)


def test_the_node_answers_while_clip_works(clip_relocalizer, tester):
    future = tester.ask()
    tester.wait(lambda: tester.listened_to() > 0, 'the relocalizer to listen')
    before = clip_relocalizer.cpu_s()
    tester.feed_until(lambda: clip_relocalizer.cpu_s() > before + 0.3 or future.done(),
                      crowded_frame(), 'CLIP to work')
    latencies = []
    while not future.done():
        start = time.monotonic()
        tester.call(GetParameters, '/relocalizer/get_parameters',
                    GetParameters.Request(names=['k']))
        latencies.append(time.monotonic() - start)
    clip_ms = int(re.search(r'CLIP (\d+) ms', future.result().message).group(1))
    print(f'\nwhile CLIP worked for {clip_ms} ms on fifty crops, {len(latencies)} parameter '
          f'requests were answered within {max(latencies) * 1e3:.0f} ms')
    assert clip_ms > 500
    assert len(latencies) >= 2
    assert max(latencies) * 1e3 < clip_ms / 2
