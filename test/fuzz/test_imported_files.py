# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of other systems, broken or hostile: a map that can be read back, or an error."""


import numpy as np
import pytest
from foreign_maps import (
    bytes_field,
    goreloc_file,
    msgloc_text,
    number_field,
    oaslam_files,
    oaslam_text,
    table_text,
    varint,
)
from garbage import CASES, number
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.map_formats.given_map import COCO, place, read_msgloc, read_table
from cliploc_ros.offline.datasets.map_formats.quadric_maps import read_goreloc, read_oaslam

SOUND = LandmarkMap('map', ('a', 'b'), ('a', 'b'), ('cup', 'book'),
                    np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]]), np.full((2, 3), 0.2),
                    Rotation.random(2, random_state=0).as_quat())
READERS = {'theirs.csv': lambda path: read_table(path),
           'theirs.json': lambda path: read_msgloc(path, COCO),
           'theirs.objects': lambda path: read_goreloc(path, COCO),
           'theirs.txt': lambda path: read_oaslam(path, COCO),
           'theirs.mapobjects': lambda path: read_oaslam(path, COCO)}
FILES = {'theirs.csv': table_text(SOUND).encode(), 'theirs.json': msgloc_text(SOUND).encode(),
         'theirs.objects': goreloc_file(SOUND), 'theirs.txt': oaslam_text(SOUND).encode(),
         'theirs.mapobjects': oaslam_files(SOUND)[0]}
field = st.deferred(lambda: st.one_of(
    st.builds(number_field, st.integers(1, 6), st.integers(0, 2**64 - 1)),
    st.builds(bytes_field, st.integers(1, 6), st.one_of(
        st.binary(max_size=20), message, st.lists(number, max_size=20).map(
            lambda values: np.clip(values, -3e38, 3e38).astype('<f4').tobytes())))))
message = st.lists(field, max_size=5).map(b''.join)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp('theirs')
    (path / 'theirs.objecttracks').write_bytes(oaslam_files(SOUND)[1])
    return path


def read(folder, name, content):
    """Read a file; what comes of it must be a map that can be written and read."""
    (folder / name).write_bytes(content)
    try:
        found = place(READERS[name](folder / name), 'theirs', 'map', 1.0, np.eye(4))
    except DatasetError as error:
        assert len(str(error)) < 1000
        return
    write_map(folder / 'map.yaml', found.landmark_map)
    assert len(LandmarkMap.from_file(folder / 'map.yaml')) == len(found.landmark_map)


@pytest.mark.parametrize('name', READERS)
@given(data=st.data())
@CASES
def test_damage(folder, name, data):
    """A sound file in which a stretch is replaced, or that ends early."""
    sound = FILES[name]
    start = data.draw(st.integers(0, len(sound)))
    end = data.draw(st.one_of(st.just(len(sound)),
                              st.integers(start, min(len(sound), start + 50))))
    read(folder, name, sound[:start] + data.draw(st.binary(max_size=8)) + sound[end:])


def test_a_count_beyond_the_file_takes_no_memory(folder):
    read(folder, 'theirs.objects', b'\x0a' + varint(2**63) + b'\x0a')
