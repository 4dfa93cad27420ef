# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Coverage and places that look alike in the studio, without a browser."""

import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from scene import make_layer
from scipy.spatial.transform import Rotation
from studio_map import write_two_rooms

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.landmark import map_of
from cliploc_ros.offline.studio.layers import tile_colors
from cliploc_ros.offline.studio.places import find_places
from cliploc_ros.offline.studio.studio import Studio


@pytest.fixture
def studio(tmp_path):
    write_two_rooms(tmp_path / 'map.yaml')
    studio = Studio(Document(tmp_path / 'map.yaml'))
    yield studio
    studio.document.close()


def silent(share):
    pass


def test_an_edit_changes_the_figures_and_the_positions_stay(studio):
    document = studio.document
    before = find_places(document.landmarks, None, None, silent)
    assert len(before.look_alikes) == 1 and len(before.look_alikes[0].matched) == 5
    assert before.figures['pairs of places that look alike'] == '1'
    second_room = [key for key, landmark in document.landmarks.items() if landmark.center[0] > 3.5]
    document.edit(edits.set_fields, [second_room[1]], center=[8.6, 1.3, 0.2])
    document.edit(edits.set_fields, [second_room[2]], center=[6.6, -0.3, 0.9])
    after = find_places(document.landmarks, None, before, silent)
    assert not after.look_alikes
    assert np.array_equal(after.grid.positions, before.grid.positions)
    lines = after.lines(before)
    assert any(line.endswith('alike: 0 (was 1)') for line in lines)
    assert any(re.search(r'\d+ of \d+ \(was \d+ of \d+\)', line) for line in lines)
    again = find_places(document.landmarks, None, after, silent)
    assert again.figures == after.figures, 'equal maps give equal numbers'


def test_the_time_is_bounded(studio):
    places = find_places(studio.document.landmarks, None, None, silent, limit_s=0.0)
    assert len(places.check.positions) == 1 < len(places.grid.positions)
    assert len(places.check.trials) == places.check.headings
    assert any(line.startswith('time is up') for line in places.lines(None))


def test_positions_that_only_keyframes_reach_are_told_apart(studio):
    """The words are those of the check, with a separate colour."""
    landmarks = studio.document.landmarks
    without = find_places(landmarks, None, None, silent)
    figure = 'where a robot is localized'
    count, lost = len(without.check.positions), np.nonzero(without.check.accepted == 0)[0]
    objects = count - len(lost)
    assert len(lost) > 1
    assert without.figures[figure] == (
        f'{count} positions: {objects} localized by objects, 0 by keyframes only, '
        f'{len(lost)} not localized')
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses = np.array([make_transform(
        Rotation.from_euler('z', angle, degrees=True).as_matrix() @ level, place)
        for place in without.check.positions for angle in range(0, 360, 30)])
    layer = replace(make_layer(map_of(landmarks), len(poses), points=1), map_from_camera=poses)
    found = find_places(landmarks, None, None, silent, layer=layer)
    assert found.figures[figure] == (
        f'{count} positions: {objects} localized by objects, {len(lost)} by keyframes only, '
        '0 not localized')
    was, now = tile_colors(without), tile_colors(found)
    is_lost = (without.check.accepted == 0) & (without.check.misled == 0)
    assert (was[~is_lost] == now[~is_lost]).all()
    assert (now[is_lost] == (0, 150, 136)).all() and (was[is_lost] != (0, 150, 136)).any()


def test_a_search_is_stopped_and_grows_old(studio):
    """The first progress report comes from the search's thread, which then waits for the test."""
    document = studio.document

    def search():
        with pytest.raises(CliplocError, match='stopped'):
            studio.search_places()

    thread = threading.Thread(target=search)
    studio.changed.clear()
    thread.start()
    studio.changed.wait()
    document.edit(edits.set_fields, ['cup_0'], label='a red cup')
    studio.stop_search()
    thread.join()
    assert studio.places is None
    studio.allow_search()
    studio.search_places()
    assert not studio.is_stale and studio.share == 1.0
    document.edit(edits.delete, ['cup_0'])
    assert studio.is_stale
    document.undo()
    assert not studio.is_stale, 'the map is unchanged'
    document.edit(edits.mark, ['cup_0'], 'lock', is_locked=True)
    assert not studio.is_stale, 'a lock changes nothing'
