# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The document of the map studio: edits, undo, saving, embeddings and journal; no browser."""

import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from studio_map import TEXT

from cliploc_ros.core.map import landmark_embeddings as images_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import CliplocError, DatasetError, MapError
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'office.yaml'
    path.write_text(TEXT)
    return path


@pytest.fixture
def document(path):
    document = Document(path)
    yield document
    document.close()


def changed_lines(path):
    """Return the lines that were removed and added, without indentation."""
    old, new = TEXT.splitlines(), path.read_text().splitlines()
    return ([line.strip() for line in old if line not in new],
            [line.strip() for line in new if line not in old])


def test_edits_change_their_lines_only(document, path):
    """A list over several lines, a folded text, a new field, a removed field, a new landmark."""
    document.edit(edits.set_fields, ['cup_1'], center=[1.25, 2, 0.5])
    document.save()
    assert changed_lines(path) == (['center: [1.0, 2.0, 0.5]   # from the plan'],
                                   ['center: [1.25, 2.0, 0.5]   # from the plan'])
    document.edit(edits.set_fields, ['book_1', 'plant_1'], label='yes: "no" # <b>')
    document.edit(edits.set_fields, ['book_1'], center=[0, 0, 1e-6])
    document.edit(edits.set_fields, ['book_1'], class_id='off')
    document.edit(edits.create, 'a lamp', 'floor lamp', np.ones(3), np.eye(3))
    document.save()
    found = LandmarkMap.from_file(path)
    assert found.landmark_ids == ('cup_1', 'book_1', 'plant_1', 'floor_lamp_1')
    assert found.labels[:3] == ('a red cup', 'yes: "no" # <b>', 'yes: "no" # <b>')
    assert found.class_ids == ('cup', 'off', 'plant', 'floor lamp')
    assert found.centers[:2].tolist() == [[1.25, 2.0, 0.5], [0.0, 0.0, 1e-6]]
    assert [detail.source for detail in found.details] == [None, None, None, 'studio']
    text = path.read_text()
    assert "map_file: ''  # the relocalizer's own" in text
    assert '# the red one' in text and "# Ann's" in text and '# Hz' in text
    assert read_parameter_file(path)['other_node'] == {'ros__parameters': {'rate': 5.0}}


def test_a_map_in_braces_is_rewritten(path):
    path.write_text('{/**: {ros__parameters: {map: {frame_id: map, landmarks: {cup_1: {label: cup,'
                    ' class_id: cup, center: [0, 0, 0], semi_axes: [1, 1, 1],'
                    ' orientation: [0, 0, 0, 1]}}}}}}')
    document = Document(path)
    document.edit(edits.create, 'a lamp', 'lamp', np.ones(3), np.eye(3))
    document.save()
    assert LandmarkMap.from_file(path).landmark_ids == ('cup_1', 'lamp_1')


def test_unknown_fields_stay_and_the_relocalizer_refuses_them(path):
    text = TEXT.replace('class_id: cup', 'class_id: cup\n          colour: {name: red, rgb: [1]}')
    path.write_text(text)
    document = Document(path)
    assert any("'colour'" in note and 'refuses' in note for note in document.notes)
    document.edit(edits.set_fields, ['cup_1'], label='a cup')
    document.save()
    assert 'colour: {name: red, rgb: [1]}' in path.read_text()
    with pytest.raises(MapError, match='colour'):
        LandmarkMap.from_file(path)


def test_every_edit_is_undone_and_done_again(document):
    def state():
        return {key: (one, one.is_locked) for key, one in document.landmarks.items()}

    states = [state()]
    for edit, chosen, values in ((edits.set_fields, ['cup_1'], {'orientation': [0, 0, 2, 2]}),
                                 (edits.set_fields, ['cup_1', 'book_1'], {'label': 'same'}),
                                 (edits.split, 'book_1', {}),
                                 (edits.merge, ['book_1', 'book_2', 'cup_1'], {}),
                                 (edits.mark, ['plant_1'], {'what': 'lock', 'is_locked': True}),
                                 (edits.delete, ['book_1'], {})):
        document.edit(edit, chosen, **values)
        document.select(['cup_1'])
        assert state() != states[-1]
        states.append(state())
    for before in states[-2::-1]:
        gone = set(before) - set(document.landmarks)
        assert document.undo()
        assert state() == before
        assert not gone or set(document.selection) == gone, 'it shows what is back'
    assert not document.undo() and document.is_saved
    for after in states[1:]:
        assert document.redo()
        assert state() == after
    assert not document.redo()


@pytest.mark.parametrize(('edit', 'message'), [
    (lambda all: edits.set_fields(all, ['cup_1'], center=[float('nan'), 0, 0]), 'not finite'),
    (lambda all: edits.set_fields(all, ['cup_1'], orientation=[0, 0, 0, 0]), 'no direction'),
    (lambda all: edits.set_fields(all, ['cup_1'], semi_axes=[0.1, 0.1, 0]), 'at least 0.001 m'),
    (lambda all: edits.delete(all, ['sofa']), "no landmark 'sofa'")])
def test_what_no_map_may_hold_is_refused(document, edit, message):
    with pytest.raises(CliplocError, match=message):
        document.apply(edit(document.landmarks))
    assert document.is_saved and document.to_undo is None


def test_merging_halves_gives_back_the_whole(document):
    """The halves of a split lie within the original; their joint moments are near its moments."""
    whole = document.landmarks['plant_1']
    document.edit(edits.split, 'plant_1')
    first, second = (document.landmarks[key] for key in ('plant_1', 'plant_2'))
    assert np.allclose(0.5 * (first.center + second.center), whole.center)
    assert np.isclose(first.semi_axes.prod() + second.semi_axes.prod(), whole.semi_axes.prod(),
                      rtol=1e-4)
    document.edit(edits.merge, ['plant_1', 'plant_2'])
    merged = document.landmarks['plant_1']
    document.edit(edits.merge, ['cup_1', 'book_1'])
    assert dict(document.landmarks['cup_1'].details.class_weights) == pytest.approx(
        {'cup': 0.5, 'book': 0.45, 'tv': 0.05})
    assert np.allclose(merged.center, whole.center, atol=1e-5)
    # S_zz = .15^2 + 5 * .15^2, hand-computed; x and y stay
    squares = np.sort(np.linalg.eigvalsh(merged.basis @ merged.basis.T))
    assert np.allclose(squares, [0.1**2, 0.15**2, 6 * 0.15**2], rtol=1e-4)


# ---- the file on the disk

def test_a_file_that_changed_on_disk_is_not_overwritten(document, path):
    document.edit(edits.set_fields, ['cup_1'], label='mine')
    theirs = f'# set {"1" * 12} {"2" * 12}\n' + TEXT.replace('a red cup', 'theirs')  # an update
    path.write_text(theirs)
    with pytest.raises(MapError, match='another program'):
        document.save()
    assert path.read_text() == theirs
    assert document.has_conflict
    assert 'office.yaml' in document.overwrite() and not document.has_conflict
    found = LandmarkMap.from_file(path)
    assert found.labels[0] == 'mine' and found.map_set.digest == '2' * 12


def test_reloading_is_an_edit(document, path):
    document.edit(edits.set_fields, ['cup_1'], label='mine')
    document.edit(edits.delete, ['book_1'])
    path.write_text(f'# set {"1" * 12} {"2" * 12}\n' + TEXT.replace('a red cup', 'theirs'))
    document.reload()
    assert 'views and keyframes are those from before' in document.notes[-1]
    assert document.is_saved and document.landmarks['cup_1'].label == 'theirs'
    assert set(document.landmarks) == {'cup_1', 'book_1', 'plant_1'}
    document.undo()
    assert document.landmarks['cup_1'].label == 'mine' and 'book_1' not in document.landmarks


def test_a_file_that_is_gone_is_saved_but_not_reloaded(document, path):
    path.unlink()
    with pytest.raises(MapError, match='no such file; saving writes it'):
        document.reload()
    document.save()
    assert LandmarkMap.from_file(path).landmark_ids == tuple(document.landmarks)


def test_two_studios_do_not_edit_one_map(path):
    first = Document(path)
    with pytest.raises(DatasetError, match='another studio'):
        Document(path)
    first.close()
    Document(path).close()
    assert list(path.parent.iterdir()) == [path], 'no journal is left'


def act(document, action, number):
    """Do one action of a random session; return the document, which may be a new one."""
    ids, landmarks = list(document.landmarks), document.landmarks
    if action in ('undo', 'redo', 'save'):
        getattr(document, action)()
    elif action == 'reopen':
        document.close()
        document = Document(document.path)
        assert document.landmarks == landmarks
    elif ids:
        one = ids[number % len(ids)]
        edit, what, values = {
            'move': (edits.set_fields, [one], {'center': [number, 1 / 3, -number]}),
            'split': (edits.split, one, {}), 'delete': (edits.delete, [one], {}),
            'label': (edits.set_fields, [one], {'label': f"label '{number}': #é\n"}),
            'merge': (edits.merge, ids[:2], {})}[action]
        document.edit(edit, what, **values)
    return document


@settings(max_examples=60)
@given(st.lists(st.tuples(st.sampled_from(['move', 'split', 'delete', 'undo', 'redo', 'save',
                                           'label', 'merge', 'reopen']),
                          st.integers(0, 50)), max_size=12))
def test_any_session_ends_as_its_file_says(tmp_path_factory, session):
    path = tmp_path_factory.mktemp('any') / 'office.yaml'
    path.write_text(TEXT)
    document = Document(path)
    for action, number in session:
        with suppress(EditError):
            document = act(document, action, number)
    if document.landmarks:
        document.save()
        tree = read_parameter_file(path)['/**']['ros__parameters']['map']['landmarks']
        assert tree == {key: dict(landmark.fields) for key, landmark in document.landmarks.items()}
    document.close()


# ---- the image embeddings

IDS = ('plant_1', 'gone_1', 'cup_1', 'book_1')  # not in the map's order, with one extra
SIZE = 16


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float16)


@pytest.fixture
def rows(path):
    """Write embeddings next to the map; return the original mean and medoids by landmark."""
    path.write_text(TEXT.replace('position_sigma: 0.01', 'support: 3'))
    rng = np.random.default_rng(0)
    given = images_of.LandmarkEmbeddings(
        'demo:key', IDS, unit(rng.normal(size=(4, SIZE))), unit(rng.normal(size=(16, SIZE))),
        np.array([0, 5, 7, 12, 16]))
    images_of.save_landmark_embeddings(images_of.embeddings_path(path), given)
    return rows_of(path)


def rows_of(path):
    found = images_of.load_landmark_embeddings(images_of.embeddings_path(path))
    return {key: (found.means[row], found.medoids[slice(*found.medoid_offsets[row:row + 2])])
            for row, key in enumerate(found.landmark_ids)}


def is_equal(first, second):
    return all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


def test_rows_follow_their_landmarks(path, rows):
    """A merged landmark has the weighted mean, each half the original rows, a new one none."""
    document = Document(path)
    document.edit(edits.merge, ['cup_1', 'book_1'])
    document.edit(edits.split, 'plant_1')
    document.edit(edits.create, 'new', 'book', np.ones(3), np.eye(3))
    assert is_equal(rows_of(path)['cup_1'], rows['cup_1']), 'only saving writes'
    document.save()
    found = rows_of(path)
    assert sorted(found) == ['book_1', 'cup_1', 'plant_1', 'plant_2']
    mean = rows['cup_1'][0].astype(float) + 3.0 * rows['book_1'][0].astype(float)
    np.testing.assert_allclose(found['cup_1'][0], mean / np.linalg.norm(mean), atol=2e-3)
    both = np.concatenate([rows['cup_1'][1], rows['book_1'][1]])
    assert len(found['cup_1'][1]) == 5
    assert all((both == medoid).all(axis=1).any() for medoid in found['cup_1'][1])
    assert is_equal(found['plant_1'], rows['plant_1'])
    assert is_equal(found['plant_2'], rows['plant_1'])
    assert not found['book_1'][0].any() and not len(found['book_1'][1]), 'not the old book'
    known = images_of.load_embeddings_of_map(path, sorted(found)).is_known
    assert known.tolist() == [False, True, True, True]
    for _ in range(3):
        document.undo()
    document.save()
    found = rows_of(path)
    assert set(found) == {'cup_1', 'book_1', 'plant_1'}
    assert all(is_equal(found[key], rows[key]) for key in found)
    document.close()


def test_an_unusable_file_stays(path):
    images_of.embeddings_path(path).write_bytes(b'of another program')
    document = Document(path)
    assert any('npz file' in note for note in document.notes)
    document.edit(edits.delete, ['book_1'])
    document.save()
    document.close()
    assert images_of.embeddings_path(path).read_bytes() == b'of another program'


# ---- the journal of a session that was killed

EDITOR = """
import sys, numpy as np
from pathlib import Path
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
document = Document(Path(sys.argv[1]))
document.edit(edits.mark, ['book_1'], 'lock', is_locked=True)
document.edit(edits.delete, ['plant_1'])
document.save()
document.edit(edits.set_fields, ['cup_1'], label='undone')
document.undo()
x = 0
while True:
    x += 1
    document.edit(edits.set_fields, ['cup_1'], center=[x, 0, 0], gesture='drag')
    print(x, flush=True)
"""


def test_a_killed_studio_loses_nothing(path):
    editor = subprocess.Popen([sys.executable, '-c', EDITOR, path], stdout=subprocess.PIPE,
                              text=True, cwd=Path(__file__).parents[2])
    for line in editor.stdout:
        if int(line) >= 100:
            editor.send_signal(signal.SIGKILL)
            break
    last = int([line, *editor.stdout.readlines()][-1])
    editor.wait()
    document = Document(path)
    assert document.landmarks['cup_1'].center[0] >= last
    assert 'plant_1' not in document.landmarks
    assert any('restored' in note for note in document.notes)
    document.undo()
    assert document.is_saved, 'the drag is one edit'
    document.close()


def journal_of(path):
    return path.with_name(f'.{path.name}.studio')


def test_replay_between_announcing_and_writing(path):
    """The studio was killed while saving: either content has the correct edits."""
    document = Document(path)
    document.edit(edits.set_fields, ['cup_1'], label='first')
    document._journal.append({'writing': document.file.with_landmarks(document.landmarks).digest})
    written = document.file.with_landmarks(document.landmarks).text
    document._journal.close()
    again = Document(path)
    assert again.landmarks['cup_1'].label == 'first' and not again.is_saved
    again._journal.close()
    path.write_text(written)
    again = Document(path)
    assert again.landmarks['cup_1'].label == 'first' and again.is_saved
    assert not journal_of(path).with_name(f'{journal_of(path).name}.1').exists(), 'set aside'


def test_edits_of_another_content_are_set_aside(path):
    document = Document(path)
    document.edit(edits.set_fields, ['cup_1'], label='mine')
    document.close()
    path.write_text(TEXT.replace('a red cup', 'theirs'))
    document = Document(path)
    assert document.landmarks['cup_1'].label == 'theirs'
    (note,) = document.notes
    aside = path.with_name(re.search(r'kept in (\S+)', note)[1])
    assert '"mine"' in aside.read_text()


@pytest.mark.parametrize('tail', [
    b'{"do": "edit", "what": "cu', b'\xff\xfe\n', b'{}\n',
    b'{"do": "edit", "what": "x", "after": {"a": {"label": NaN}}}\n',
    b'{"do": "edit", "what": "x", "after": {"cup_1": {"label": "a", "class_id": "a", '
    b'"orientation": [0, 0, 0, 1], "semi_axes": [1, 1, 1], '
    b'"center": [1' + b'0' * 400 + b', 0, 0]}}}\n'])
def test_a_broken_journal_loses_its_end_only(path, tail):
    document = Document(path)
    document.edit(edits.set_fields, ['cup_1'], label='mine')
    document.close()
    with journal_of(path).open('ab') as file:
        file.write(tail)
    document = Document(path)
    assert document.landmarks['cup_1'].label == 'mine'
    assert set(document.landmarks) == {'cup_1', 'book_1', 'plant_1'}
    document.edit(edits.set_fields, ['cup_1'], label='mine, too')
    document.close()
    assert Document(path).landmarks['cup_1'].label == 'mine, too'
