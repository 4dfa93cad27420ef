# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map files of a broken editor or an attacker give a valid map or an error."""

import numpy as np
import pytest
import yaml
from garbage import CASES, number
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError

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


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('maps')


def read(folder, content):
    """Read the content: a valid map, or an error that names the file."""
    path = folder / 'map.yaml'
    path.write_bytes(content)
    try:
        found = LandmarkMap.from_file(path)
    except MapError as error:
        assert 'map.yaml' in str(error)
        assert len(str(error)) < 10_000
        return None
    assert np.isfinite(found.centers).all() and np.isfinite(found.shapes).all()
    assert (found.semi_axes > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(found.quats_xyzw, axis=1), 1.0)
    return found


@given(landmark_map)
@CASES
def test_trees(folder, content):
    nodes = {'/**': {'ros__parameters': {'map': content}}}
    read(folder, yaml.safe_dump(nodes, allow_unicode=True).encode('utf-8', 'surrogatepass'))


