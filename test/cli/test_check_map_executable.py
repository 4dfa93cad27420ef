# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable check_map."""

import json
from functools import partial

import numpy as np
import pytest
from scene import doubled_room, make_room

from cliploc_ros.cli.check_map import main
from cliploc_ros.core.map.map_file import write_map

FAST = ('--positions', 4, '--headings', 2)


@pytest.fixture
def check_map(run_here):
    return partial(run_here, main)


@pytest.fixture
def room_file(tmp_path):
    write_map(tmp_path / 'room.yaml', make_room())
    return tmp_path / 'room.yaml'


def test_a_map_without_observations(check_map, room_file, tmp_path):
    done = check_map(room_file, '--out', tmp_path / 'out', '--min-positions', 0, *FAST)
    assert done.returncode == 0, done.stdout + done.stderr
    checked = json.loads((tmp_path / 'out/check.json').read_text())
    assert checked['map'] == 'room.yaml'
    assert checked['passed']
    assert checked['recording'] is None
    assert len(checked['landmarks']) == 12
    page = (tmp_path / 'out/check.html').read_text()
    assert page.startswith('<!DOCTYPE html>')
    assert page.endswith('</html>\n')
    assert 'data:image/png;base64,' in page


def test_a_doubled_map_fails(check_map, tmp_path):
    write_map(tmp_path / 'doubled.yaml', doubled_room(np.zeros(3)))
    done = check_map(tmp_path / 'doubled.yaml', '--out', tmp_path / 'out', *FAST)
    assert done.returncode == 1
    assert 'duplicates: 12 > 0' in done.stdout
    assert 'delete one of them' in done.stdout
    assert not json.loads((tmp_path / 'out/check.json').read_text())['passed']


@pytest.mark.parametrize(('args', 'named'), [
    (('{folder}/missing.yaml', '--out', '{folder}/out'), 'missing.yaml'),
    (('{room}', '--observations', '{room}', '--out', '{folder}/out'), 'npz'),
    (('{room}', '--images', '{folder}', '--out', '{folder}/out'), '--observations')])
def test_what_to_correct_is_named(check_map, room_file, tmp_path, args, named):
    done = check_map(*(argument.format(folder=tmp_path, room=room_file) for argument in args))
    assert done.returncode == 1
    assert done.stderr.startswith('error: ')
    assert named in done.stderr
    assert 'Traceback' not in done.stderr
    assert not (tmp_path / 'out/check.json').exists()


def test_the_office_passes_but_for_its_doubles(check_map, shared_data, tmp_path):
    office = shared_data / 'tum_fr3_office'
    done = check_map(office / 'map.yaml', '--observations', office / 'observations.npz',
                     '--every', 20, '--frames', 10,
                     '--min-positions', 0, '--max-duplicates', 3, '--max-faulty', 0.25,
                     '--out', tmp_path, *FAST)
    assert done.returncode == 0, done.stdout + done.stderr
    checked = json.loads((tmp_path / 'check.json').read_text())
    assert checked['recording']['held_out']['explained'] > 0.8
    # all images show these two pairs; a third one, a spoon in a cup, has few boxes here
    doubles = [{overlap['first'], overlap['second']} for overlap in checked['overlaps']
               if overlap['is_duplicate']]
    assert len(doubles) == 3
    assert {'teddy_bear_1', 'chair_3'} in doubles and {'refrigerator_1', 'book_5'} in doubles
