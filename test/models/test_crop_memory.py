# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A standing robot's crops are encoded once: the demo's CLIP on the demo's images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.observer import CropMemory, Observer
from demo.truth import read_frames

ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
FRAMES = list(read_frames(ASSETS / 'sequence', 0.5))
FRAME = max(FRAMES, key=lambda frame: len(frame.boxes))
IMAGE = cv2.imread(str(FRAME.image))[..., ::-1].copy()
BOXES = np.array([box.bbox_xyxy for box in FRAME.boxes])


def noisy(seed, deviation=3.0):
    noise = np.random.default_rng(seed).normal(0.0, deviation, IMAGE.shape)
    return (IMAGE + noise).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def encoder():
    options = ClipOptions(model=str(ASSETS / 'clip.json'), device='cpu',
                          pretrained=str(ASSETS / 'clip.safetensors'))
    return ClipEncoder(resolve_clip_weights(options), options)


@pytest.fixture
def observer(encoder):
    """An observer that has seen the image once."""
    made = Observer(encoder, np.eye(encoder.embed_dim, dtype=np.float32))
    crops = made.crops(noisy(1), BOXES)
    assert len(crops.known) == 0
    crops.compare(np.arange(len(BOXES)))
    return made


def test_the_same_view_is_not_encoded_again(observer, encoder):
    again = noisy(2)
    shaken = BOXES + np.random.default_rng(3).uniform(-0.5, 0.5, BOXES.shape)
    crops = observer.crops(again, shaken)
    share = len(crops.known) / len(BOXES)
    reused = np.asarray(crops.compare(crops.known).crops)
    cosines = np.sum(reused * encoder.encode_crops(again, shaken[crops.known]), axis=1)
    assert share > 0.7
    print(f'\n{share:.2f} of {len(BOXES)} crops are reused; cosine with new embeddings: least '
          f'{cosines.min():.3f}, median {np.median(cosines):.3f}')
    assert np.median(cosines) > 0.98


def test_another_view_is_encoded_anew(observer):
    moved = BOXES + 3.0
    assert len(observer.crops(noisy(2), moved).known) == 0, 'other boxes'
    assert len(observer.crops(255 - noisy(2), BOXES).known) == 0, 'other pixels'
    other = next(one for one in FRAMES if one is not FRAME)
    image = cv2.imread(str(other.image))[..., ::-1].copy()
    assert len(observer.crops(image, BOXES).known) == 0, 'another image'
    covered, box = noisy(2), BOXES[np.argmax(np.prod(BOXES[:, 2:] - BOXES[:, :2], axis=1))]
    left, top, right, bottom = box.astype(int)
    covered[top:top + (bottom - top) // 3, left:right] = 255
    rows = observer.crops(covered, box[None]).known
    assert len(rows) == 0, 'a third of the object is covered'


def test_memory_is_bounded():
    memory = CropMemory()
    for seed in range(40):
        memory.keep(noisy(seed), BOXES, np.zeros((len(BOXES), 4), dtype=np.float32))
    assert len(memory) == min(256, 40 * len(BOXES)) and 40 * len(BOXES) > 256


def test_without_time_no_crop_fits_and_a_slow_moment_passes(encoder):
    observer = Observer(encoder, np.eye(encoder.embed_dim, dtype=np.float32))
    assert observer.crops_within(0.001) == 1, 'nothing is known of its speed'
    observer.measure()
    assert observer.crops_within(0.0) == observer.crops_within(-np.inf) == 0
    assert observer.crops_within(np.inf) > 10
    observer._crop_s = 100.0  # as of a machine that was busy
    tries = 0
    while not observer.crops_within(10.0):
        tries += 1
        assert tries < 30
