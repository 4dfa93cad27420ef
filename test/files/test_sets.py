# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sets of files, written by processes that are killed or that share a folder."""

import fcntl
import multiprocessing
import os
import random
import signal
import stat
import time
from dataclasses import replace

import numpy as np
import pytest
from whole_sets import ROOM, made_map, write_set

from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
from cliploc_ros.core.map.landmark_embeddings import embeddings_path, load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import removed_path, set_digest, write_map
from cliploc_ros.errors import DatasetError, MapError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.offline.datasets.map_recording import MapRecording, load_recording, recording_path
from cliploc_ros.offline.mapping.make_map import MadeMap, write_made_map
from cliploc_ros.offline.studio.document import Document

KILLS = 12


def read(path):
    """Return the number in each file of a map."""
    landmark_map = LandmarkMap.from_file(path)
    embeddings = load_embeddings_of_map(path, landmark_map.landmark_ids, landmark_map.map_set)
    number = round(float((landmark_map.centers - ROOM.centers)[0, 0]) / 0.01)
    return number, {number % 8 == int(np.argmax(embeddings.means[0])),
                    *(number == load_layer_of_map(layer_path(place), landmark_map).points[0, 0]
                      for place in (path, removed_path(path))),
                    number == load_recording(path).scale - 1.0,
                    number == load_recording(path).load().stamps_s[0]}


def hidden(path):
    return {entry.name for entry in path.parent.iterdir() if entry.name.startswith('.')}


@pytest.fixture
def path(tmp_path):
    (tmp_path / 'seen.npz').touch()
    write_set(tmp_path / 'a.yaml', 0)
    return tmp_path / 'a.yaml'


def write_again_and_again(path, first, begun, after):
    for number in range(first, first + 1000):
        if number == first + after:
            begun.set()
        write_set(path, number)


def test_a_kill_leaves_one_whole_set(path):
    """The writes of build_map are killed at random times."""
    draw, seen, left, fork = random.Random(0), set(), set(), multiprocessing.get_context('fork')
    for kill in range(KILLS):
        begun = fork.Event()
        writer = fork.Process(target=write_again_and_again,
                              args=(path, 1000 * kill + 1, begun, draw.randrange(3)), daemon=True)
        writer.start()
        assert begun.wait(60.0)
        time.sleep(draw.uniform(0.0, 0.03))
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        number, agree = read(path)
        assert agree == {True}
        seen.add(number)
        left |= hidden(path)
    print(f'{KILLS} kills, {len(seen)} sets, {len(left)} files left')
    assert len(seen) > KILLS / 3, 'the kills happen during writes'
    assert left
    with replace_file(path.with_name('b')) as of_this_writer:
        write_set(path, 0)
        assert hidden(path) == {of_this_writer.name}
        of_this_writer.touch()
    assert not hidden(path)


def test_files_of_another_set_are_refused(path):
    """A partial copy of a folder gives such files."""
    others = [path.with_name('b.yaml')]
    write_set(others[0], 5)
    for of in (embeddings_path, layer_path, recording_path):
        of(others[0]).replace(of(path))
    landmark_map = LandmarkMap.from_file(path)
    with pytest.raises(MapError, match='is of the set'):
        load_embeddings_of_map(path, landmark_map.landmark_ids, landmark_map.map_set)
    with pytest.raises(MapError, match='is of the set'):
        load_layer_of_map(layer_path(path), landmark_map)
    with pytest.raises(DatasetError, match='is of the set'):
        load_recording(path)
    document = Document(path)
    document.close()
    assert 'is of the set' in document.notes[0]
    assert all(landmark.look is None for landmark in document.landmarks.values())


def test_the_studio_finishes_what_a_killed_writer_left(path):
    others = embeddings_path(path)
    digest = LandmarkMap.from_file(path).map_set.digest
    others.rename(others.with_name(f'.{digest}.{others.name}'))
    document = Document(path)
    document.close()
    assert others.exists() and document.file.encoder_key == 'key'


def test_an_update_writes_a_new_set_unless_another_update_was_faster(path):
    recording, before = MapRecording(path.with_name('seen.npz')), LandmarkMap.from_file(path)
    first, second = (replace(made_map(number), embeddings=None, updated=path.read_text())
                     for number in (1, 2))
    write_made_map(path, first, [], recording, path)
    after = LandmarkMap.from_file(path)
    assert after.map_set.family == after.map_set.digest != before.map_set.digest
    assert load_layer_of_map(layer_path(path), after).points[0, 0] == 1
    assert not embeddings_path(path).exists()
    with pytest.raises(MapError, match='another program changed it'):
        write_made_map(path, second, [], recording, path)
    assert LandmarkMap.from_file(path).map_set == after.map_set
    write_made_map(path.with_name('b.yaml'), second, [], recording, path)


def test_a_map_by_hand_takes_any_files(path):
    """Files without a set are those of earlier versions."""
    path.write_text(''.join(line for line in path.read_text().splitlines(keepends=True)
                            if not line.startswith('# set ')))
    landmark_map = LandmarkMap.from_file(path)
    assert load_layer_of_map(layer_path(path), landmark_map).points[0, 0] == 0
    assert load_recording(path).scale == 1.0


def test_a_set_that_cannot_be_written_changes_nothing(path):
    blocker = path.with_name(f'.{"x" * 250}')
    with pytest.raises((MapError, DatasetError)):
        write_map(path, made_map(3).landmark_map, besides={blocker: lambda place, digest:
                                                          place.write_text(digest)})
    assert read(path) == (0, {True})
    assert not hidden(path)


def test_two_writers_at_once_leave_one_whole_set(path):
    """As with build_map in two terminals: the last one wins with all of its files."""
    fork = multiprocessing.get_context('fork')
    for turn in range(3):
        writers = [fork.Process(target=lambda numbers: [write_set(path, tag) for tag in numbers],
                                args=(range(first, first + 10),))
                   for first in (100 * turn, 100 * turn + 10)]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        assert [writer.exitcode for writer in writers] == [0, 0]
        assert read(path)[1] == {True}
    assert not hidden(path)


def test_what_a_killed_writer_left_comes_not_into_a_later_set_without_it(path):
    """As if build_map were killed and run again with --no-keyframe-layer: equal landmarks."""
    digest = set_digest(made_map(1).landmark_map)
    layer_path(path).rename(path.with_name(f'.{digest}.{layer_path(path).name}'))
    write_made_map(path, replace(made_map(1), layer=None), [],
                   MapRecording(path.with_name('seen.npz')))
    LandmarkMap.from_file(path)
    assert not layer_path(path).exists()
    assert not hidden(path)


def test_files_of_a_set_stay_private_and_links_stay_links(path, tmp_path):
    """As in replace_file: images of keyframes are private."""
    layer_path(path).chmod(0o600)
    (tmp_path / 'store').mkdir()
    stored = tmp_path / 'store' / 'embeddings.npz'
    embeddings_path(path).rename(stored)
    embeddings_path(path).symlink_to(stored)
    write_set(path, 1)
    assert read(path) == (1, {True})
    assert stat.S_IMODE(layer_path(path).stat().st_mode) == 0o600
    assert embeddings_path(path).is_symlink() and not stored.is_symlink()


def test_sets_of_keyframes_alone_are_told_apart(path):
    """Their maps are equal: both are empty. Objects may be drawn into the map later."""
    empty, digests = LandmarkMap.empty('map'), set()
    layer = replace(made_map(0).layer, landmark_ids=(), landmark_centers=np.empty((0, 3), 'f4'))
    for name in ('a', 'b'):
        place = path.with_name(f'{name}.yaml')
        write_made_map(place, MadeMap(empty, None, layer=layer), [],
                       MapRecording(path.with_name('seen.npz')))
        load_layer_of_map(layer_path(place), LandmarkMap.from_file(place))
        digests.add(LandmarkMap.from_file(place).map_set.digest)
    assert len(digests) == 2
    layer_path(path).replace(layer_path(place))
    with pytest.raises(MapError, match='is of the set'):
        load_layer_of_map(layer_path(place), LandmarkMap.from_file(place))


def test_a_writer_that_keeps_the_others_out_is_named(tmp_path, monkeypatch):
    """Such as by a process that was stopped while writing."""
    monkeypatch.setattr('cliploc_ros.files.storage._TURN_S', 0.3)
    path = tmp_path / 'office.yaml'
    write_map(path, ROOM)
    before = path.read_bytes()
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(MapError, match=r'another program has been writing there for 0\.3 s'):
        write_map(path, ROOM)
    os.close(descriptor)
    assert path.read_bytes() == before
    write_map(path, ROOM)
