# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of labels and phrases: the cache on disk, its failures, and weighted labels."""

import os
import pickle
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.models import label_embeddings
from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.label_embeddings import LabelCache, mixed_rows
from cliploc_ros.models.phrase_embeddings import embed_phrases

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
    lambda file: file.write_bytes(b''),
    lambda file: file.write_bytes(file.read_bytes()[:200]),
    lambda file: file.write_bytes(file.read_bytes()[:-30]),
    lambda file: file.write_bytes(file.read_bytes().replace(unit_rows(3)[1].tobytes(), b'x' * 64)),
    lambda file: file.write_bytes(b'no archive at all'),
    lambda file: file.write_bytes(pickle.dumps({'embeddings': 1})),
    lambda file: np.savez(file, other=np.zeros(3)),
    lambda file: np.savez(file, identity=np.array([object()]), embeddings=unit_rows(3)),
    lambda file: np.savez(file, identity=np.zeros(3, np.uint8), embeddings=unit_rows(3)),
], ids=['empty', 'truncated', 'no directory', 'flipped bytes', 'text', 'pickle', 'foreign',
        'objects', 'other identity'])
def test_damaged_file_is_ignored_and_replaced(cache, damage, caplog):
    file = stored_file(cache)
    damage(file)
    assert cache.load(KEY, LABELS, 16) is None
    assert 'cannot be used' in caplog.text and str(file) in caplog.text
    cache.store(KEY, LABELS, unit_rows(3))
    assert np.array_equal(cache.load(KEY, LABELS, 16), unit_rows(3))


def test_a_full_disk_costs_only_the_cache(tmp_path):
    # A limit on the size of files gives the error of write() that a full disk gives.
    code = f"""
import logging, resource, numpy as np
from pathlib import Path
from cliploc_ros.models.label_embeddings import LabelCache
logging.basicConfig()
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
cache = LabelCache(Path({str(tmp_path)!r}))
cache.store('key', ['label'], np.ones((1, 512), np.float32))
assert cache.load('key', ['label'], 512) is None
"""
    done = subprocess.run([sys.executable, '-c', code], cwd=PROJECT, capture_output=True,
                          text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert 'not cached' in done.stderr and 'File too large' in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_many_processes_share_a_folder(tmp_path):
    code = f"""
import sys, numpy as np
from pathlib import Path
from cliploc_ros.models.label_embeddings import LabelCache
cache = LabelCache(Path({str(tmp_path)!r}))
rows = np.eye(4, 512, dtype=np.float32)
for turn in range(100):
    cache.store('key', list('abcd'), rows)
    found = cache.load('key', list('abcd'), 512)
    assert found is not None and np.array_equal(found, rows)
"""
    children = [subprocess.Popen([sys.executable, '-c', code], cwd=PROJECT, text=True,
                                 stderr=subprocess.PIPE) for _ in range(4)]
    for child in children:
        _, errors = child.communicate(timeout=300)
        assert child.returncode == 0 and not errors, errors
    assert len(list(tmp_path.iterdir())) == 1


def test_the_longest_unused_files_go(cache):
    for number in range(40):
        cache.store(KEY, [f'label {number}'], unit_rows(1))
        newest = max(cache._folder.glob('*.npz'), key=lambda file: file.stat().st_mtime_ns)
        os.utime(newest, (number, number))
        # A file that every start uses is never removed.
        assert cache.load(KEY, ['label 0'], 16) is not None
    assert len(list(cache._folder.iterdir())) == 32
    assert cache.load(KEY, ['label 1'], 16) is None
    assert cache.load(KEY, ['label 39'], 16) is not None


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


def test_each_label_is_encoded_once_and_parts_change_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    descriptions = [tuple((f'{number:03d}', float(weight)) for number, weight in zip(
        rng.choice(100, 6, replace=False), rng.uniform(0.1, 1, 6), strict=True))
        for _ in range(70)]
    embeddings = {f'{number:03d}': row for number, row in enumerate(
        rng.normal(size=(100, 8)).astype(np.float32))}
    asked = []

    def encode_some(labels):
        asked.append(list(labels))
        return np.array([embeddings[label] for label in labels])

    whole = mixed_rows(descriptions, encode_some, 8)
    monkeypatch.setattr(label_embeddings, 'PART', 16)
    monkeypatch.setattr(label_embeddings, '_BLOCK', 32)
    assert mixed_rows(descriptions, encode_some, 8) == pytest.approx(whole, abs=1e-6)
    assert max(map(len, asked[1:])) == 16
    assert list(chain(*asked[1:])) == asked[0] == sorted(set(asked[0]))
    assert np.linalg.norm(whole, axis=1) == pytest.approx(1.0, abs=1e-6)


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
    assets = PROJECT / 'cliploc_ros/demo/assets'
    return ClipOptions(model=str(assets / 'clip.json'), device='cpu', cache_dir=str(tmp_path),
                       pretrained=str(assets / 'clip.safetensors'))


def test_each_class_is_encoded_once(clip, caplog):
    weights = resolve_clip_weights(clip)
    found = embed_phrases(weights, clip, PHRASES)
    assert list(found) == list(PHRASES)
    for name, texts in PHRASES.items():
        alone = encode_labels(weights, texts, clip)
        np.testing.assert_allclose(found[name], alone, atol=1e-6)
    assert 'CLIP reads 3 phrases of 2 classes' in caplog.text
    caplog.clear()
    more = embed_phrases(weights, clip, PHRASES | {'can': ('a can', 'a tin')})
    assert 'CLIP reads 2 phrases of 1 classes' in caplog.text
    caplog.clear()
    again = embed_phrases(weights, clip, {'can': ('a can', 'a tin'), 'mug': PHRASES['mug']})
    assert caplog.text == ''
    assert list(again) == ['can', 'mug']
    np.testing.assert_array_equal(again['can'], more['can'])
    np.testing.assert_array_equal(again['mug'], found['mug'])
    assert embed_phrases(weights, clip, {}) == {}
