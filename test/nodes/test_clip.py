# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer with a real CLIP, of random weights: none trained is at hand.

Its similarities mean nothing, so every landmark is made a candidate (k = 12) and the sampler is
given enough samples to find the pose all the same. What is shown is the whole path, not the use
of CLIP.
"""

import re
import signal
import time

import open_clip
import pytest
import torch
from conftest import make_frame, transform_of
from rcl_interfaces.srv import GetParameters
from scene import MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.observation import Detections
from cliploc_ros.core.transforms import pose_error


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('clip') / 'vit_b_32.pt'
    torch.save(open_clip.create_model('ViT-B-32').state_dict(), path)
    return path


@pytest.fixture(scope='module')
def cache_dir(tmp_path_factory):
    return tmp_path_factory.mktemp('cache')


@pytest.fixture
def clip_relocalizer(own_relocalizer, checkpoint, cache_dir):
    def run(**parameters):
        return own_relocalizer(**{
            'matching': 'hybrid', 'algorithm': 'b-prosac', 'k': 12, 'iterations': 30000,
            'clip_model': 'ViT-B-32', 'clip_pretrained': checkpoint, 'cache_dir': cache_dir,
            **parameters})
    return run


def crowded_frame():
    """A frame with fifty boxes: the room's and many more."""
    seen = see_room(make_room())
    rows = [row % len(seen) for row in range(50)]
    return make_frame(Detections(seen.bboxes_xyxy[rows], tuple(seen.class_ids[r] for r in rows),
                                 seen.scores[rows]), stamp_s=5.0)


def test_crops_lead_to_a_pose_and_the_second_start_is_warm(clip_relocalizer, tester):
    print()
    for name in ('first start', 'with a warm cache'):
        process = clip_relocalizer()
        assert ('encoded' if name == 'first start' else 'cached') in process.output()
        assert tester.relocalize(make_frame()).success
        tester.wait(lambda: tester.poses, 'a pose')
        pose = transform_of(tester.poses.pop().pose.pose)
        assert pose_error(pose, MAP_FROM_CAMERA) < (0.05, 1.0)
        seconds = re.search(r'ready after ([0-9.]+) s', process.output()).group(1)
        print(f'{name}: ready after {seconds} s, at most {process.memory_mib("VmHWM"):.0f} MiB')
        process.stop()
        tester.wait(lambda: tester.count_publishers('/relocalizer/pose') == 0, 'its end')


def test_the_node_answers_while_clip_works(clip_relocalizer, tester):
    clip_relocalizer()
    future = tester.ask()
    tester.wait(lambda: tester.listened_to() > 0, 'the relocalizer to listen')
    frame = crowded_frame()
    begun = time.monotonic()
    tester.feed_until(lambda: time.monotonic() > begun + 0.3 or future.done(), frame)
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


@pytest.mark.parametrize('signal_number', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_node_while_clip_works(clip_relocalizer, tester, signal_number):
    process = clip_relocalizer()
    future = tester.ask()
    tester.feed_until(lambda: tester.listened_to() == 0 or future.done(), crowded_frame(),
                      'the frame to be taken')
    code, seconds = process.stop(signal_number)
    print(f'\nended after {seconds:.2f} s')
    assert code == 0, process.output()
    assert seconds < 2.0
    assert 'Traceback' not in process.output()


def test_weights_of_another_model_are_named(own_relocalizer, checkpoint, cache_dir, tester):
    process = own_relocalizer(
        expect='[ERROR]', matching='hybrid', algorithm='b-prosac', clip_model='ViT-B-16',
        clip_pretrained=checkpoint, cache_dir=cache_dir)
    answer = tester.answer(tester.ask())
    assert not answer.success
    assert str(checkpoint) in answer.message
    assert 'ViT-B-16' in answer.message
    assert process.alive


def test_truncated_weights_are_named(own_relocalizer, checkpoint, cache_dir, tester, tmp_path):
    half = tmp_path / 'half.pt'
    with checkpoint.open('rb') as file:
        half.write_bytes(file.read(checkpoint.stat().st_size // 2))
    process = own_relocalizer(
        expect='[ERROR]', matching='hybrid', algorithm='b-prosac', clip_model='ViT-B-32',
        clip_pretrained=half, cache_dir=cache_dir)
    answer = tester.answer(tester.ask())
    assert not answer.success
    assert str(half) in answer.message
    assert process.alive
