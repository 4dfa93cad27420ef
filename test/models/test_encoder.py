# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Label embeddings and their cache; images of landmarks; crops that are encoded once."""

import hashlib
import json
import os
import stat
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scene import ROOM, embeddings_of, unit_rows

from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import embeddings_path, save_landmark_embeddings
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import CliplocError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models import clip_encoder
from cliploc_ros.models.files import digest_file, fingerprint_file
from cliploc_ros.models.observer import Observer, crop_bounds
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions
from cliploc_ros.offline.mapping.labelling import embed_phrases
from demo import ASSETS
from demo.truth import read_frames

KEY = 'ViT-B-32:gelu:0123'
LABELS = ['a red mug', 'tasse bleue é', "it's \0 odd"]


def rows_of(count: int, size: int = 16) -> np.ndarray:
    return unit_rows(np.random.default_rng(0).normal(size=(count, size)).astype(np.float32))


@pytest.mark.parametrize('damage', [
    lambda file: file.write_bytes(file.read_bytes()[:200]),
    lambda file: file.write_bytes(file.read_bytes().replace(rows_of(3)[1].tobytes(), b'x' * 64)),
    lambda file: np.savez(file, other=np.zeros(3)),
    lambda file: np.savez(file, identity=np.zeros(3, np.uint8), embeddings=rows_of(3))])
def test_the_cache_finds_what_it_stored_and_nothing_else(tmp_path, damage, caplog):
    """It keeps one file, and leaves the user's own files alone."""
    own = tmp_path / 'deep' / 'labels' / 'image_7.txt'
    cache = clip_encoder.LabelCache(own.parent, most_files=1)
    for _ in range(2):
        cache.store(KEY, LABELS[:2], rows_of(2))
        own.touch()
        cache.store(KEY, LABELS, rows_of(3))
        assert np.array_equal(cache.load(KEY, LABELS, 16), rows_of(3))
        for key, labels in (('ViT-B-32:gelu:0124', LABELS), (KEY, LABELS[:2]),
                            (KEY, LABELS[::-1]), (KEY, ['a red mug', 'tasse', "it's \0 odd"])):
            assert cache.load(key, labels, 16) is None
        assert not caplog.records
        file, _ = sorted(own.parent.iterdir(), reverse=True)  # and the user's own
        damage(file)
        assert cache.load(KEY, LABELS, 16) is None
        assert 'cannot be used' in caplog.text and str(file) in caplog.text
        caplog.clear()


@pytest.fixture(scope='module')
def clip(tmp_path_factory):
    return ClipOptions(pretrained=str(ASSETS / 'clip'),
                       cache_dir=str(tmp_path_factory.mktemp('cache')))


# ---- phrases are encoded once, class by class
MUG, BOX, CAN = ('a red mug', 'a blue mug with white dots'), ('a box',), ('a can', 'a tin')


def test_each_class_is_encoded_once(clip, caplog):
    weights = resolve_clip_weights(clip)
    found = embed_phrases(weights, clip, [MUG, BOX])
    assert list(found) == [MUG, BOX]
    for texts, (own, rows) in found.items():
        assert own == texts
        encoded = clip_encoder.encode_labels(weights, texts, clip)
        np.testing.assert_allclose(rows, encoded, atol=1e-6)
    assert '3 phrases in 2 groups' in caplog.text
    caplog.clear()
    more = embed_phrases(weights, clip, [MUG, BOX, CAN])
    assert '2 phrases in 1 groups' in caplog.text
    caplog.clear()
    again = embed_phrases(weights, clip, [CAN, MUG])
    assert caplog.text == ''
    assert list(again) == [CAN, MUG]
    np.testing.assert_array_equal(again[CAN].embeddings, more[CAN].embeddings)
    np.testing.assert_array_equal(again[MUG].embeddings, found[MUG].embeddings)
    assert embed_phrases(weights, clip, []) == {}


# ---- the rows of a map: labels, images, or both


@pytest.fixture
def map_file(tmp_path):
    write_map(tmp_path / 'room.yaml', ROOM)
    return tmp_path / 'room.yaml'


def images_of(clip, ids=ROOM.landmark_ids):
    weights = resolve_clip_weights(clip)
    return embeddings_of(ids, rows_of(len(ids), weights.embed_dim), weights.key)


def test_labels_with_weights_are_mixed(clip):
    described = replace(ROOM, details=(
        LandmarkDetails(labels=((ROOM.labels[0], 3.0), ('a red cup', 1.0))),
        *[LandmarkDetails()] * (len(ROOM) - 1)))
    rows = np.asarray(clip_encoder.embed_map(clip, described, [], 'both'))
    plain = np.asarray(clip_encoder.embed_map(clip, ROOM, [], 'both'))
    assert np.array_equal(rows[1:], plain[1:])
    expected = np.array([3.0, 1.0]) @ clip_encoder.encode_labels(
        resolve_clip_weights(clip), [ROOM.labels[0], 'a red cup'], clip)
    assert rows[0] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-5)


@pytest.mark.parametrize('compare', ['image', 'both'])
def test_images_of_this_encoder_are_compared(clip, map_file, compare):
    images = images_of(clip)
    save_landmark_embeddings(embeddings_path(map_file), images)
    plain = np.asarray(clip_encoder.embed_map(clip, ROOM, [str(map_file)], 'text'))
    rows = np.asarray(clip_encoder.load_encoder_for_map(clip, ROOM, [str(map_file)], compare)[1])
    assert np.array_equal(plain, np.asarray(clip_encoder.embed_map(clip, ROOM, [], compare)))
    similar = np.sum(rows * images.means, axis=1)
    assert (similar > np.sum(plain * images.means, axis=1) + 0.2).all()
    if compare == 'image':
        assert np.array_equal(rows, images.means)
    # rows follow the map's order; added landmarks use their label
    save_landmark_embeddings(embeddings_path(map_file), images.in_order(ROOM.landmark_ids[:0:-1]))
    again = np.asarray(clip_encoder.embed_map(clip, ROOM, [str(map_file)], compare))
    assert np.isfinite(again).all()
    assert np.argmax(again[1:] @ images.means[1:].T, axis=1).tolist() == list(range(len(ROOM) - 1))


def test_images_of_several_maps_are_compared_together_or_not_at_all(clip, tmp_path, caplog):
    """Each map keeps its rows; if one map has no images, all are compared by labels."""
    maps = [replace(ROOM, frame_id='hall'), replace(ROOM, frame_id='attic').select([2, 0, 1])]
    files = [str(tmp_path / f'{landmark_map.frame_id}.yaml') for landmark_map in maps]
    both = join_maps(maps, files)
    expected = [images_of(clip, landmark_map.landmark_ids) for landmark_map in maps]
    for one, file, images in zip(maps, files, expected, strict=True):
        write_map(file, one)
        save_landmark_embeddings(embeddings_path(file), images)
    rows = clip_encoder.embed_map(clip, both, files, 'image')
    assert np.array_equal(np.asarray(rows), np.concatenate([each.means for each in expected]))
    caplog.clear()
    embeddings_path(files[1]).unlink()
    plain = np.asarray(clip_encoder.embed_map(clip, ROOM, [], 'text'))
    rows = clip_encoder.embed_map(clip, both, files, 'image')
    assert np.array_equal(np.asarray(rows), plain[[*range(len(ROOM)), 2, 0, 1]])
    warning, = (record for record in caplog.records if record.levelname == 'WARNING')
    assert f'{files[1]} has no image embeddings' in warning.getMessage()


# ---- boxes and images
@pytest.mark.parametrize(('bbox', 'bounds'), [
    ([10.2, 20.8, 30.1, 40.9], [10, 20, 31, 41]),
    ([-50.0, -50.0, 1000.0, 1000.0], [0, 0, 64, 48]),
    ([63.5, 47.5, 1e300, 1e300], [63, 47, 64, 48]), ([64.0, 10.0, 80.0, 20.0], None),
    ([30.0, 10.0, 20.0, 20.0], None), ([np.nan, 10.0, np.inf, 20.0], None)])
def test_box(bbox, bounds):
    bboxes = np.array([bbox])
    if bounds is not None:
        assert crop_bounds(bboxes, 64, 48).tolist() == [bounds]
    else:
        with pytest.raises(CliplocError, match=r'box 0, .*64x48'):
            crop_bounds(bboxes, 64, 48)


def test_fingerprint(tmp_path):
    file, found, content = tmp_path / 'weights', set(), np.random.default_rng(0).bytes(20_000_000)
    with pytest.raises(CliplocError, match='weights cannot be read'):
        fingerprint_file(file)
    # A retrained tensor is longer than the gap between two blocks.
    for offset in (0, len(content) // 2, len(content) - 1):
        file.write_bytes(content[:offset] + bytes(400_000) + content[offset + 400_000:])
        found.add(fingerprint_file(file))
    for other in (content, content[:-1], b''):
        file.write_bytes(other)
        found.add(fingerprint_file(file))
        assert fingerprint_file(file) in found
    assert len(found) == 6
    # Only a digest covers the gap, which ends after the first 64 KiB and 1/65 of the file.
    digests = set()
    for byte in (b'0', b'1'):
        file.write_bytes(content[:70_000] + byte + content[70_001:])
        digests.add((fingerprint_file(file), digest_file(file)))
    assert len({found for found, _ in digests}) == 1 and len(digests) == 2



def test_digests_of_large_files_are_kept_until_they_change(tmp_path):
    file, cache = tmp_path / 'model.onnx', str(tmp_path)
    file.write_bytes(bytes(2**24))
    assert digest_file(file, cache) == digest_file(file)
    assert not (tmp_path / 'digests').exists(), 'a change at once could have the same time'
    old = max(Path(np.__file__).parents[1].rglob('*.so*'), key=lambda path: path.stat().st_size)
    link = tmp_path / 'link'
    link.symlink_to(old)
    digest = digest_file(link, cache)
    kept, = (tmp_path / 'digests').iterdir()
    forged = json.dumps(['1' * 64, []])
    for text, expected in ((f'{hashlib.sha256(forged.encode()).hexdigest()} {forged}', '1' * 64),
                           (f'0 {forged}', digest), ('', digest), ('\0', digest)):
        kept.write_text(text)
        assert digest_file(link, cache) == expected
    assert digest_file(link) == digest
    kept.parent.chmod(0o777)  # others could have written it
    kept.write_text(f'{hashlib.sha256(forged.encode()).hexdigest()} {forged}')
    assert digest_file(link, cache) == digest
    before = file.stat()
    file.write_bytes(bytes(2**24 - 1) + b'1')
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert digest_file(file, cache) == hashlib.sha256(file.read_bytes()).hexdigest()


# ---- crops
FRAMES = list(read_frames(ASSETS / 'sequence', 0.5))
FRAME = max(FRAMES, key=lambda frame: len(frame.boxes))
IMAGE = cv2.imread(str(FRAME.image))[..., ::-1].copy()
BOXES = np.array([box.bbox_xyxy for box in FRAME.boxes])


def noisy(seed, deviation=3.0):
    noise = np.random.default_rng(seed).normal(0.0, deviation, IMAGE.shape)
    return (IMAGE + noise).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def encoder(clip):
    return clip_encoder.ClipEncoder(resolve_clip_weights(clip), clip)


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
    print(f'\n{share:.2f} of {len(BOXES)} crops are reused; cosine with new embeddings: least '
          f'{cosines.min():.3f}, median {np.median(cosines):.3f}')
    assert share > 0.7 and np.median(cosines) > 0.98


def test_another_view_is_encoded(observer):
    assert len(observer.crops(noisy(2), BOXES + 3.0).known) == 0, 'other boxes'
    assert len(observer.crops(255 - noisy(2), BOXES).known) == 0, 'other pixels'
    other = next(frame for frame in FRAMES if frame is not FRAME)
    image = cv2.imread(str(other.image))[..., ::-1].copy()
    assert len(observer.crops(image, BOXES).known) == 0, 'another image'
    covered, box = noisy(2), BOXES[np.argmax(np.prod(BOXES[:, 2:] - BOXES[:, :2], axis=1))]
    left, top, right, bottom = box.astype(int)
    covered[top:top + (bottom - top) // 3, left:right] = 255
    assert len(observer.crops(covered, box[None]).known) == 0, 'a third of the object is covered'


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


# ---- the folder of the cache


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


def test_a_cache_that_others_can_write_to_is_not_used(monkeypatch, tmp_path, caplog):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    shared = tmp_path / 'cliploc_ros'
    shared.mkdir()
    shared.chmod(0o777)
    folder = resolve_cache_dir('')
    assert folder.name.startswith('cliploc_ros_cache_') and resolve_cache_dir('') == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert f'other users own {shared} or can write to it' in caplog.text
