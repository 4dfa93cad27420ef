# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of precision and recall: every request counts once, in every mode that is possible."""

import re

import pytest

from cliploc_ros.errors import CliplocError
from studies.acceptance import recorded as acceptance
from studies.acceptance.places import ALL, FIVE, MODES, ONE, Simulated
from studies.acceptance.recorded import Outcome


def cells(line):
    return [one.strip() for one in line.strip('|').split('|')]


def test_a_simulated_room_is_searched_in_every_mode(capsys):
    assert acceptance.run(['--worlds', '1', '--kinds', 'room']) == 0
    own, _, elsewhere = capsys.readouterr().out.strip().partition('\n\n')
    rows = [cells(line) for line in own.splitlines()[2:] if line.startswith('| room')]
    assert [row[1] for row in rows] == [*MODES, *MODES], 'by labels and by classes'
    for row in rows:
        right, requests = map(int, row[2].split(' of '))
        assert requests == 4
        for cell in row[3:-1]:
            accepted, wrong = map(int, re.match(r'(\d+), (\d+);', cell).groups())
            assert accepted - wrong <= right
            assert accepted <= requests
    assert cells(elsewhere.splitlines()[-1])[:2] == ['all', '40']


def test_modes_without_further_images_are_left_out():
    place = Simulated('room', 1000)()
    assert place.modes == MODES
    every = place._replace(every_frame=True)
    assert len(every.ask(FIVE)) == len(place.ask(ONE)) == 4, 'one of each group'
    assert len(every.ask(ONE)) == len(place.frames) == 20
    alone = place._replace(groups=range(len(place.frames)))
    assert not {FIVE, ALL} & set(alone.modes)


@pytest.mark.parametrize(('least', 'cell'), [(0.99, '1, 0; 0.50'), (0.9, '3, 1; 1.00')])
def test_what_a_threshold_accepts(least, cell):
    outcomes = [Outcome('room', MODES[0], 'hybrid', False, right, confidence)
                for right, confidence in ((True, 0.995), (True, 0.92), (False, 0.91), (False, 0))]
    row = cells(acceptance.table(outcomes, [least]).splitlines()[2])
    assert row[2:] == ['2 of 4', cell, '1.00']


def test_a_place_elsewhere_has_false_accepts_only():
    outcomes = [Outcome('room', MODES[0], 'class', True, False, confidence)
                for confidence in (0.995, 0.2)]
    row = cells(acceptance.elsewhere_table(outcomes, [0.97]).splitlines()[2])
    assert row[:2] == ['room', '2']
    assert row[2].startswith('1 [')


@pytest.mark.parametrize('words', [[], ['--worlds', '1', '--min-confidence', 'nan'],
                                   ['--queries', '/nowhere.npz', '--map', '/nowhere.yaml']])
def test_bad_options_are_named(words):
    with pytest.raises(CliplocError):
        acceptance.run(words)
