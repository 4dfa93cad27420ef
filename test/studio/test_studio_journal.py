# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The journal of the map studio: the remains of a session that was killed."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from studio_map import TEXT

from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'office.yaml'
    path.write_text(TEXT)
    return path


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
    document._journal.append({'writing': document._file.with_landmarks(
        document.landmarks).digest})
    written = document._file.with_landmarks(document.landmarks).text
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
