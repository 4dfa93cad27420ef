# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged or hostile files of every format give their content or an error.

For files with checksums, the content is the written one, whatever bits have flipped.
"""

import io
import json
import os
import random
import time
import zipfile
from dataclasses import is_dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scene import CAMERA
from whole_sets import ROOM, write_set

from cliploc_ros.core.keyframes.layer import load_layer_of_map
from cliploc_ros.core.map.landmark_embeddings import load_landmark_embeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.query import CASE, Case, Query, case_arrays, read_case
from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.models.clip_encoder import LabelCache
from cliploc_ros.offline.datasets.given_map import read_table
from cliploc_ros.offline.datasets.map_recording import load_recording
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.datasets.parsing import Fields
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

#: Default number of cases per property; CLIPLOC_FUZZ_CASES=10000 requests more.
CASES = settings(max_examples=int(os.environ.get('CLIPLOC_FUZZ_CASES', '200')), deadline=None,
                 derandomize=True)
number = st.one_of(st.floats(), st.floats(-1000.0, 1000.0), st.integers(-10, 10).map(float))
LABELS = ['a mug', 'a book']
TABLE = 'id,class_id,x,y,z,a,b,c\n' + ''.join(
    f'cup_{row},cup,{row}.5,1,2,.1,.1,.2\n' for row in range(8))


def labels(path):
    cache = LabelCache(path.parent)
    path.rename(cache._file('key', LABELS))
    return cache.load('key', LABELS, 8)


@pytest.fixture(scope='module')
def sound(tmp_path_factory):
    """Return the folder of valid files, one of each format."""
    folder = tmp_path_factory.mktemp('sound')
    save_observations(folder / 'seen.npz', PosedDetections(
        (CAMERA,), np.tile(np.eye(4), (3, 1, 1)), np.arange(3.0), np.array([0, 2, 2, 3]),
        np.array([[1.0, 2, 30, 40], [5, 6, 70, 80], [9, 9, 20, 30]]), ('cup', 'book'),
        np.array([0, 1, 0]), np.array([0.5, 0.75, 1.0]), depths=np.array([1.0, 2.0, np.nan]),
        embeddings=np.eye(3, 8, dtype=np.float16), encoder_key='key'))
    write_set(folder / 'a.yaml', 3)
    frame = Observation(CAMERA, Detections(np.array([[1.0, 2, 30, 40]]), ('cup',), np.ones(1)),
                        None)
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    CASE.write(folder / 'case.npz', case_arrays(Case((Query((frame,), (image,)),), {})))
    rows = np.eye(2, 8, dtype=np.float32)
    LabelCache(folder / 'cache').store('key', LABELS, rows)
    next((folder / 'cache').iterdir()).rename(folder / 'labels.npz')
    (folder / 'table.csv').write_text(TABLE)
    (folder / 'camera.json').write_text(json.dumps({'width': 640, 'k': [1.0] * 9}))
    return folder


FORMATS = {
    'seen.npz': load_observations, 'a.embeddings.npz': load_landmark_embeddings,
    'a.keyframes.npz': lambda path: load_layer_of_map(path, ROOM), 'case.npz': read_case,
    'labels.npz': labels, 'a.yaml': LandmarkMap.from_file,
    'a.recording.json': lambda path: load_recording(path.with_name('a.yaml')),
    'table.csv': read_table,
    'camera.json': lambda path: Fields.of_file(path).numbers('k', (9,))}


def damaged(content, draw):
    """Draw content with flipped bits, without a part, or with a part moved."""
    changed = bytearray(content)
    match draw.randrange(4):
        case 0 | 1:
            for _ in range(draw.choice([1, 1, 2, 8])):
                changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
        case 2:
            begin = draw.randrange(len(changed))
            del changed[begin:begin + draw.choice([1, 10, 1000, len(changed)])]
        case _:
            begin, to, size = (draw.randrange(len(changed)) for _ in range(3))
            changed[to:to + size % 64] = changed[begin:begin + size % 64]
    return bytes(changed)


def plain(value):
    """Return a reader's result as values that can be compared."""
    if is_dataclass(value):
        return {name: plain(var) for name, var in vars(value).items() if not name.startswith('_')}
    if isinstance(value, np.ndarray):
        return value.tobytes(), value.shape
    return [plain(item) for item in value] if isinstance(value, tuple | list) else repr(value)


@pytest.mark.parametrize('name', FORMATS)
def test_damage_is_named_or_changes_nothing(sound, tmp_path, name):
    content, draw = (sound / name).read_bytes(), random.Random(name)
    for other in ('seen.npz', 'a.yaml'):
        (tmp_path / other).write_bytes((sound / other).read_bytes())
    path = tmp_path / name
    path.write_bytes(content)
    right, refused, longest_s = plain(FORMATS[name](path)), 0, 0.0
    for _ in range(CASES.max_examples):
        path.write_bytes(damaged(content, draw))
        begun_s = time.monotonic()
        try:
            found = FORMATS[name](path)
        except CliplocError as error:
            assert len(str(error)) < 1000
            found = None
        longest_s = max(longest_s, time.monotonic() - begun_s)
        refused += found is None
        if name.endswith('.npz') and found is not None:
            assert plain(found) == right
    print(f'{refused} of {CASES.max_examples} refused, the longest took {longest_s:.2f} s')
    assert longest_s < 2.0


# ---- what one file can stop: examples -----------------------------------------------------------
def bomb(path, shape, compression=zipfile.ZIP_DEFLATED, declared=None):
    """Write an observation file whose array of boxes has, or claims, a huge number of zeros."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {
        'descr': '<f8', 'fortran_order': False, 'shape': declared or shape})
    content = header.getvalue() + bytes(8 * int(np.prod(shape)))
    with zipfile.ZipFile(path) as archive:
        others = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, 'w', compression, compresslevel=1) as archive:
        for one, data in (others | {'boxes_xyxy.npy': content}).items():
            archive.writestr(one, data)


@pytest.mark.parametrize(('change', 'named'), [
    (partial(bomb, shape=(20_000_000, 4)), 'unpacks to 610 MiB'),
    (partial(bomb, shape=(3, 4), declared=(10**12, 4)), 'expected 32000000000000')])
def test_an_npz_of_gigabytes_is_not_unpacked(sound, tmp_path, change, named):
    path = tmp_path / 'seen.npz'
    path.write_bytes((sound / 'seen.npz').read_bytes())
    change(path)
    begun_s = time.monotonic()
    with pytest.raises(CliplocError, match=named):
        load_observations(path)
    assert time.monotonic() - begun_s < 1.0


@pytest.mark.parametrize(('text', 'named'), [
    ('{"k": [' + '[],' * 5_000_000 + '[]]}', 'more than 8000000 values'),
    ('{"k": ' * 9999, 'nested too deeply'), ('{"k": [1' + '0' * 400 + ']}', '401 digits'),
    ('{"k": [1' + '0' * 9999 + ']}', 'digits')])
def test_json_is_bounded(tmp_path, text, named):
    path = tmp_path / 'camera.json'
    path.write_text(text)
    with pytest.raises(CliplocError, match=named):
        Fields.of_file(path).numbers('k', (-1,))


@pytest.mark.parametrize('text', [
    *(f'a: [{flood}1]' for flood in (
        '[],' * 1_600_000, '{},' * 1_600_000, '[[[],[]]],' * 500_000, '1, ' * 1_000_000)),
    ''.join(f'{key}: 1\n' for key in range(1_000_000))])
def test_a_flood_of_values_in_yaml_takes_no_time(tmp_path, text):
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    begun_s = time.monotonic()
    with pytest.raises(CliplocError, match=r'line \d+: .*more than 10+ (collections|values side)'):
        LandmarkMap.from_file(path)
    assert time.monotonic() - begun_s < 1.0


@pytest.mark.parametrize('make', [
    os.mkfifo, lambda path: path.symlink_to('/dev/zero'), Path.mkdir,
    lambda path: path.symlink_to('/proc/kmsg'),
    lambda path: (path.touch(), os.truncate(path, 3 * 2**30))])
def test_what_is_no_file_of_any_format_is_named_at_once(sound, tmp_path, make):
    """Includes a pipe without a writer and an endless device."""
    for name, read in FORMATS.items():
        folder = tmp_path / name
        folder.mkdir()
        for other in {'a.yaml', 'seen.npz'} - {name}:
            (folder / other).write_bytes((sound / other).read_bytes())
        make(folder / name)
        begun_s = time.monotonic()
        try:
            assert read(folder / name) is None and name in ('labels.npz', 'a.recording.json')
        except CliplocError as error:
            assert name in str(error)
        assert time.monotonic() - begun_s < 1.0


# ---- maps of a broken editor or an attacker
scalar = st.one_of(st.none(), st.booleans(), st.integers(), number, st.text(max_size=20))
tree = st.recursive(scalar, lambda inner: st.one_of(
    st.lists(inner, max_size=4), st.dictionaries(st.one_of(st.text(max_size=8), scalar), inner,
                                                 max_size=4)), max_leaves=20)
vector = st.one_of(st.lists(number, min_size=3, max_size=4), tree)
landmark = st.one_of(tree, st.fixed_dictionaries(
    {'label': st.one_of(st.text(max_size=30), tree), 'class_id': st.one_of(st.text(), tree),
     'center': vector, 'semi_axes': vector, 'orientation': vector},
    optional={'colour': scalar}))
landmark_map = st.one_of(tree, st.fixed_dictionaries(
    {'frame_id': st.one_of(st.text(max_size=10), scalar),
     'landmarks': st.one_of(tree, st.dictionaries(st.text(max_size=10), landmark, max_size=3))}))


@given(landmark_map)
@CASES
def test_any_tree_is_a_valid_map_or_an_error_that_names_the_file(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / 'trees.yaml'
    path.write_bytes(yaml.safe_dump({'/**': {'ros__parameters': {'map': content}}},
                                    allow_unicode=True).encode('utf-8', 'surrogatepass'))
    try:
        found = LandmarkMap.from_file(path)
    except MapError as error:
        assert 'trees.yaml' in str(error) and len(str(error)) < 10_000
        return
    assert np.isfinite(found.centers).all() and np.isfinite(found.shapes).all()
    assert (found.semi_axes > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(found.quats_xyzw, axis=1), 1.0)
