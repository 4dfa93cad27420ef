# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of labels and phrases: the cache on disk, its failures, and weighted labels."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.label_embeddings import LabelCache, mixed_rows
from cliploc_ros.offline.vocabulary.phrase_embeddings import embed_phrases

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
    """As a name that a person gave a landmark which build_map had described."""
    one = LandmarkDetails(labels=(('a red mug', 0.5), ('a cup', 0.2)))
    assert one.labels_with('a cup') == one.labels
    assert one.labels_with('my mug') == (('my mug', 0.5), *one.labels)
    assert LandmarkDetails().labels_with('my mug') == (('my mug', 1.0),)


# ---- phrases are encoded once, class by class

PHRASES = {'mug': ('a red mug', 'a blue mug with white dots'), 'box': ('a box',)}


@pytest.fixture
def clip(tmp_path):
    assets = PROJECT / 'demo/assets'
    return ClipOptions(model=str(assets / 'clip.json'), device='cpu', cache_dir=str(tmp_path),
                       pretrained=str(assets / 'clip.safetensors'))


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
