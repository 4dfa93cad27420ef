# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of labels, phrases and crops: disk cache, memory, and the pixels that count."""

import os
import pickle
import stat
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import CliplocError, ImageError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.images import check_image_rgb, crop_bounds, visible_boxes
from cliploc_ros.models.label_embeddings import LabelCache, mixed_rows
from cliploc_ros.models.observer import Observer
from cliploc_ros.offline.mapping.labelling import embed_phrases
from demo.truth import read_frames

KEY = 'ViT-B-32:gelu:0123'
LABELS = ['a red mug', 'tasse bleue é', "it's \0 odd"]
PROJECT = Path(__file__).resolve().parents[2]


def unit_rows(count: int, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 16)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.fixture
def cache(tmp_path) -> LabelCache:
    return LabelCache(tmp_path / 'deep' / 'labels')


def stored_file(cache: LabelCache) -> Path:
    cache.store(KEY, LABELS, unit_rows(3))
    file, = cache._folder.iterdir()
    return file


def test_stored_is_found(cache):
    cache.store(KEY, LABELS, unit_rows(3))
    assert np.array_equal(cache.load(KEY, LABELS, 16), unit_rows(3))


@pytest.mark.parametrize(('key', 'labels'), [
    ('ViT-B-32:gelu:0124', LABELS), (KEY, LABELS[:2]), (KEY, LABELS[::-1]),
    (KEY, ['a red mug', 'tasse bleue e', "it's \0 odd"]),
])
def test_other_weights_or_labels_are_not_found(cache, key, labels, caplog):
    cache.store(KEY, LABELS, unit_rows(3))
    assert cache.load(key, labels, 16) is None
    assert not caplog.records


@pytest.mark.parametrize('damage', [
    lambda file: file.write_bytes(file.read_bytes()[:200]),
    lambda file: file.write_bytes(file.read_bytes().replace(unit_rows(3)[1].tobytes(), b'x' * 64)),
    lambda file: file.write_bytes(pickle.dumps({'embeddings': 1})),
    lambda file: np.savez(file, other=np.zeros(3)),
    lambda file: np.savez(file, identity=np.zeros(3, np.uint8), embeddings=unit_rows(3))])
def test_damaged_file_is_ignored_and_replaced(cache, damage, caplog):
    file = stored_file(cache)
    damage(file)
    assert cache.load(KEY, LABELS, 16) is None
    assert 'cannot be used' in caplog.text and str(file) in caplog.text
    cache.store(KEY, LABELS, unit_rows(3))
    assert np.array_equal(cache.load(KEY, LABELS, 16), unit_rows(3))


# ---- several labels of a landmark make one embedding
AXES = {'a': [1.0, 0, 0], 'b': [0, 1.0, 0], 'c': [0, 0.6, 0.8]}


def encode(labels):
    return np.array([AXES[label] for label in labels], dtype=np.float32)


def test_the_weighted_mean_in_numbers():
    rows = mixed_rows([(('a', 3.0), ('b', 4.0)), (('c', 0.2),), (('b', 1.0), ('c', 1.0))],
                      encode, 3)
    assert rows.dtype == np.float32
    assert rows[0] == pytest.approx([0.6, 0.8, 0.0])
    assert np.array_equal(rows[1], encode('c')[0])  # to the last bit
    assert rows[2] == pytest.approx(np.array([0.0, 1.6, 0.8]) / np.sqrt(3.2))


def test_a_label_beside_the_list_counts_like_the_best():
    """As when a person renames a landmark that build_map had described."""
    one = LandmarkDetails(labels=(('a red mug', 0.5), ('a cup', 0.2)))
    assert one.labels_with('a cup') == one.labels
    assert one.labels_with('my mug') == (('my mug', 0.5), *one.labels)
    assert LandmarkDetails().labels_with('my mug') == (('my mug', 1.0),)


# ---- phrases are encoded once, class by class
PHRASES = {'mug': ('a red mug', 'a blue mug with white dots'), 'box': ('a box',)}


@pytest.fixture
def clip(tmp_path):
    assets = PROJECT / 'demo/assets'
    return ClipOptions(pretrained=str(assets / 'clip'), device='cpu', cache_dir=str(tmp_path))


def test_each_class_is_encoded_once(clip, caplog):
    weights = resolve_clip_weights(clip)
    found = embed_phrases(weights, clip, PHRASES)
    assert list(found) == list(PHRASES)
    for name, texts in PHRASES.items():
        alone = encode_labels(weights, texts, clip)
        np.testing.assert_allclose(found[name], alone, atol=1e-6)
    assert '3 phrases of 2 ' in caplog.text
    caplog.clear()
    more = embed_phrases(weights, clip, PHRASES | {'can': ('a can', 'a tin')})
    assert '2 phrases of 1 ' in caplog.text
    caplog.clear()
    again = embed_phrases(weights, clip, {'can': ('a can', 'a tin'), 'mug': PHRASES['mug']})
    assert caplog.text == ''
    assert list(again) == ['can', 'mug']
    np.testing.assert_array_equal(again['can'], more['can'])
    np.testing.assert_array_equal(again['mug'], found['mug'])
    assert embed_phrases(weights, clip, {}) == {}


nan, inf = float('nan'), float('inf')


@pytest.mark.parametrize(('bbox', 'visible', 'bounds'), [
    ([10.0, 20.0, 30.0, 40.0], True, [10, 20, 30, 40]),
    ([10.2, 20.8, 30.1, 40.9], True, [10, 20, 31, 41]),
    ([-50.0, -50.0, 1000.0, 1000.0], True, [0, 0, 64, 48]),
    ([63.5, 47.5, 1e300, 1e300], True, [63, 47, 64, 48]),
    ([64.0, 10.0, 80.0, 20.0], False, None), ([30.0, 10.0, 20.0, 20.0], False, None),
    ([nan, 10.0, 20.0, 20.0], False, None), ([0.0, 0.0, inf, 20.0], False, None)])
def test_box(bbox, visible, bounds):
    bboxes = np.array([bbox])
    assert visible_boxes(bboxes, 64, 48).tolist() == [visible]
    if visible:
        assert crop_bounds(bboxes, 64, 48).tolist() == [bounds]
    else:
        with pytest.raises(CliplocError, match=r'box 0, .*64x48'):
            crop_bounds(bboxes, 64, 48)


@given(st.lists(st.lists(st.floats(), min_size=4, max_size=4), max_size=8),
       st.integers(1, 50), st.integers(1, 50))
def test_every_visible_box_has_pixels(boxes, width, height):
    bboxes = np.array(boxes).reshape(-1, 4)
    kept = bboxes[visible_boxes(bboxes, width, height)]
    left, top, right, bottom = crop_bounds(kept, width, height).T
    assert ((left >= 0) & (left < right) & (right <= width)).all()
    assert ((top >= 0) & (top < bottom) & (bottom <= height)).all()


@pytest.mark.parametrize(('image', 'message'), [
    (np.zeros((0, 0, 3), np.uint8), 'no pixels'), (np.zeros((4, 4), np.uint8), r'\(4, 4\)'),
    (np.zeros((4, 4, 3), np.float32), 'float32')])
def test_no_image(image, message):
    with pytest.raises(ImageError, match=message):
        check_image_rgb(image)


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
    options = ClipOptions(pretrained=str(ASSETS / 'clip'), device='cpu')
    return ClipEncoder(resolve_clip_weights(options), options)


@pytest.fixture
def observer(encoder):
    """Return an observer that has seen the image once."""
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
    other = next(frame for frame in FRAMES if frame is not FRAME)
    image = cv2.imread(str(other.image))[..., ::-1].copy()
    assert len(observer.crops(image, BOXES).known) == 0, 'another image'
    covered, box = noisy(2), BOXES[np.argmax(np.prod(BOXES[:, 2:] - BOXES[:, :2], axis=1))]
    left, top, right, bottom = box.astype(int)
    covered[top:top + (bottom - top) // 3, left:right] = 255
    rows = observer.crops(covered, box[None]).known
    assert len(rows) == 0, 'a third of the object is covered'


def test_without_time_no_crop_fits_and_a_slow_moment_passes(encoder):
    observer = Observer(encoder, np.eye(encoder.embed_dim, dtype=np.float32))
    assert observer.crops_within(0.001) == 1, 'its speed is unknown'
    observer.measure()
    assert observer.crops_within(0.0) == observer.crops_within(-np.inf) == 0
    assert observer.crops_within(np.inf) > 10
    observer._crop_s = 100.0  # as on a busy machine
    tries = 0
    while not observer.crops_within(10.0):
        tries += 1
        assert tries < 30


RESOLVE = """
import logging, os, stat, sys
from cliploc_ros.files.storage import resolve_cache_dir
logging.basicConfig(format='%(levelname)s %(message)s')
folder = resolve_cache_dir('')
assert resolve_cache_dir('') == folder
print(folder, oct(stat.S_IMODE(folder.stat().st_mode)), folder.stat().st_uid == os.getuid())
"""


def resolve(*within: str, **environment: str) -> tuple[list[str], str]:
    """Resolve the default cache in a separate process; return folder, mode, owner and log."""
    variables = {name: value for name, value in os.environ.items() if name != 'XDG_CACHE_HOME'}
    done = subprocess.run([*within, sys.executable, '-c', RESOLVE], cwd=PROJECT, text=True,
                          env=variables | environment, capture_output=True, timeout=300,
                          check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr


def test_the_default_is_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.delenv('XDG_CACHE_HOME', raising=False)
    assert resolve_cache_dir('') == tmp_path / '.cache/cliploc_ros'
    monkeypatch.setenv('XDG_CACHE_HOME', 'relative is to be ignored')
    assert resolve_cache_dir('') == tmp_path / '.cache/cliploc_ros'
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'xdg'))
    assert resolve_cache_dir('') == tmp_path / 'xdg/cliploc_ros'
    assert resolve_cache_dir('~/mine') == tmp_path / 'mine'
    assert stat.S_IMODE((tmp_path / 'xdg/cliploc_ros').stat().st_mode) == 0o700


def test_a_cache_that_others_can_write_to_is_not_used(tmp_path):
    shared = tmp_path / '.cache/cliploc_ros'
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    (folder, mode, _), log = resolve(HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert Path(folder).name.startswith('cliploc_ros_cache_') and mode == '0o700'
    assert f'other users own {shared} or can write to it' in log and 'set cache_dir' in log
