# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of precision and recall: every request counts once, in every mode that is possible."""

import os
import re
import signal

import pytest

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.datasets.observations import load_observations
from cliploc_ros.errors import CliplocError
from cliploc_ros.evaluation.methods import AUTO, Method
from cliploc_ros.evaluation.run import RunError
from cliploc_ros.evaluation.trials import run_trial
from studies.acceptance.__main__ import run, run_all
from studies.acceptance.places import ALL, FIVE, MODES, ONE, Halved, Simulated
from studies.acceptance.searches import Outcome, acceptance_table

pytestmark = pytest.mark.full


def cells(line):
    return [one.strip() for one in line.strip('|').split('|')]


def test_a_simulated_room_is_searched_in_every_mode(capsys):
    assert run(['recorded', '--worlds', '1', '--kinds', 'room']) == 0
    own, *_, elsewhere = capsys.readouterr().out.strip().split('\n\n')
    rows = [cells(line) for line in own.splitlines()[2:]]
    assert [row[2] for row in rows] == [*MODES, *MODES], 'by labels and by classes'
    for row in rows:
        right, requests = map(int, row[3].split(' of '))
        assert requests == 4
        for cell in row[4:-1]:
            accepted, wrong = map(int, re.match(r'(\d+), (\d+) \(', cell).groups())
            assert accepted - wrong <= right
            assert accepted <= requests
    assert cells(elsewhere.splitlines()[-1])[:2] == ['all objects exchanged', '0 of 40']


def test_modes_without_further_images_are_left_out():
    place = Simulated('room', 1000).load()
    assert place.modes == MODES
    every = place._replace(every_frame=True)
    assert len(every.ask(FIVE)) == len(place.ask(ONE)) == 4, 'one of each group'
    assert len(every.ask(ONE)) == len(place.frames) == 20
    alone = place._replace(groups=range(len(place.frames)))
    assert not {FIVE, ALL} & set(alone.modes)


def test_random_halves_of_a_recording_map_and_ask(shared_data):
    file = shared_data / 'tum_fr3_office' / 'observations.npz'
    one, other = (Halved(file, 0, is_swapped).load() for is_swapped in (False, True))
    assert len(one.frames) + len(other.frames) == len(load_observations(file))
    asked = [{query.map_from_camera.tobytes() for query in place.frames}
             for place in (one, other)]
    assert not asked[0] & asked[1]
    some = one._replace(frames=one.frames[::50], is_main=one.is_main[::50])
    outcomes = run_trial(one.landmark_map, Method(AUTO, RelocalizerOptions(matching='class')), 0,
                         some.ask(ONE))
    assert sum(found.accepted and found.error_m < 0.3 for found in outcomes) > len(outcomes) / 2


@pytest.mark.parametrize(('least', 'cell'), [(0.99, '1, 0; 0.50'), (0.9, '3, 1; 1.00')])
def test_what_a_threshold_accepts(least, cell):
    outcomes = [Outcome('room', ONE, 'hybrid', 'none', 0.0, right, True, confidence)
                for right, confidence in ((True, 0.995), (True, 0.92), (False, 0.91), (False, 0))]
    row = cells(acceptance_table(outcomes, ['place'], [least]).splitlines()[2])
    assert row[:2] + row[3:] == ['room', '2 of 4', '1.00']
    assert re.sub(r' \(.*\)', '', row[2]) == cell


def test_a_place_elsewhere_has_false_accepts_only():
    outcomes = [Outcome('room', ONE, 'class', 'none', 0.0, False, True, confidence)
                for confidence in (0.995, 0.2)]
    row = cells(acceptance_table(outcomes, ['place'], [0.97]).splitlines()[2])
    assert row[:2] == ['room', '0 of 2']
    assert row[2].startswith('1, 1 (') and row[2].endswith('; -')


@pytest.mark.parametrize('words', [
    'recorded', 'recorded --worlds 1 --min-confidence nan', 'stress',
    'recorded --queries /nowhere.npz --map /nowhere.yaml',
    'stress --worlds 1 --only nothing_of_this', 'stress --queries a.npz b.npz',
    'stress --worlds -1'])
def test_bad_options_are_named(words):
    with pytest.raises(CliplocError):
        run(words.split())


class MakeEven:
    """Makes a function that returns a number twice, and dies at 7."""

    def __call__(self):
        def work(task):
            if task == 7:
                os.kill(os.getpid(), signal.SIGKILL)
            return [task, task]
        return work


def test_outcomes_are_all_there_in_order_or_there_are_none():
    assert run_all(MakeEven(), range(4), 'numbers', 2) == [0, 0, 1, 1, 2, 2, 3, 3]
    with pytest.raises(RunError, match='workers died again and again at one of the numbers'):
        run_all(MakeEven(), range(9), 'numbers', 2)
