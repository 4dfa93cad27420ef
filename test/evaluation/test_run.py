# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs: on any number of processes, broken off and resumed; and tuning."""

import multiprocessing
import os
import signal
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.log import Log
from cliploc_ros.offline.datasets.observations import Queries
from cliploc_ros.offline.evaluation.methods import parse_methods
from cliploc_ros.offline.evaluation.run import count_trials, read_results, run_methods
from cliploc_ros.offline.evaluation.summary import notes, summarize
from cliploc_ros.offline.evaluation.trials import make_queries

PAPER = RelocalizerOptions(iterations=60)


@pytest.fixture(scope='module')
def questions(room, recording):
    return make_queries(recording, room)


@pytest.fixture(scope='module')
def methods(room):
    return parse_methods(['class_bf', 'class_ransac', 'hybrid_b-prosac'], PAPER, len(room))


def without_times(results):
    return [replace(result, search_ms=0.0) for result in results]


@pytest.fixture(scope='module')
def results(room, questions, methods):
    return run_methods(room, methods, questions, trials=3)


def test_every_method_trial_and_query_is_there(results, methods, questions):
    assert len(results) == 7 * len(questions)
    assert sum(count_trials(method, 3) for method in methods) == 7
    keys = [(result.method, result.trial, result.query) for result in results]
    assert len(set(keys)) == len(keys)
    assert [one.method for one in summarize(results)] == [one.name for one in methods]
    solved = [result for result in results if result.solved]
    assert solved
    assert len(solved) < len(results)
    for result in results:
        assert (result.error_m is None) == (not result.solved) == (result.map_from_camera is None)


def test_trials_differ_and_repeat(results, room, questions, methods):
    sampled = [one for one in results if one.method == 'class_ransac']
    count = len(questions)
    assert ([one.score for one in sampled[:count]]
            != [one.score for one in sampled[count:2 * count]])
    again = run_methods(room, methods, questions, trials=3)
    assert without_times(again) == without_times(results)


def test_workers_do_not_matter_and_get_the_queries_once(results, room, questions, methods):
    class Counted(list):
        """Queries that count how often they are sent."""

        def __reduce__(self):
            sent.append(1)
            return list, (list(self),)

    sent = []
    found = run_methods(room, methods, Counted(questions), trials=3, workers=2)
    assert without_times(found) == without_times(results)
    assert len(sent) == 2


def test_a_dead_worker_costs_its_part_only(results, room, questions, methods):
    parts = []

    def kill_one(part):
        if not parts:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        parts.append(part)
    survived = run_methods(room, methods, questions, trials=3, workers=2, advance=kill_one)
    assert without_times(survived) == without_times(results)
    assert sum(map(len, parts)) == len(results)


def test_what_is_done_is_not_run_again(results, room, questions, methods):
    done = results[::3]
    new = []
    whole = run_methods(room, methods, questions, trials=3, done=done, advance=new.extend)
    assert without_times(whole) == without_times(results)
    assert len(new) == len(results) - len(done)


def test_similarities_follow_the_maps_order(room, recording, questions):
    turned = Queries(recording.landmark_ids[::-1], recording.intrinsics_fx_fy_cx_cy, tuple(
        replace(frame, similarities=frame.similarities[:, ::-1]) for frame in recording.frames))
    for one, other in zip(make_queries(turned, room), questions, strict=True):
        np.testing.assert_array_equal(one.observation.similarities,
                                      other.observation.similarities)


def test_an_unfinished_run_goes_on_if_it_is_the_same(results, tmp_path):
    path = tmp_path / 'log'

    def read(run):
        with closing(Log(path, OptionsError, 'make room')) as log:
            return read_results(log, run)
    with closing(Log(path, OptionsError, 'make room')) as log:
        assert read_results(log, {'trials': 3}) == []
        log.append([result.as_dict() for result in results[:2]])
        log.append([result.as_dict() for result in results[2:5]])
    assert read({'trials': 3}) == results[:5]
    whole = path.read_text()
    path.write_text(whole[:-20])
    assert read({'trials': 3}) == results[:2]
    with pytest.raises(OptionsError, match='another trials'):
        read({'trials': 4})
    lines = whole.splitlines()
    for damaged in (['rubbish', lines[1]], ['[{"method": 1}]'], ['3']):
        path.write_text('\n'.join([lines[0], *damaged, '']))
        with pytest.raises(OptionsError, match='damaged'):
            read({'trials': 3})


def test_crops_on_demand_are_a_part_of_all(room, questions):
    """The last one sees twelve objects: its classes suffice. The first one sees two."""
    options = replace(PAPER, iterations=2000)
    found = {crops: run_methods(room, parse_methods(['auto'], replace(options, crops=crops),
                                                    len(room)), questions, trials=1)
             for crops in ('all', 'on_demand')}
    assert {one.crops_share for one in found['all']} == {1.0}
    shares = [one.crops_share for one in found['on_demand']]
    assert shares[0] == 1.0 and shares[-1] == 0.0
    assert [one.accepted for one in found['on_demand']] == [one.accepted for one in found['all']]
    assert all(share == 1.0 or one.accepted
               for share, one in zip(shares, found['on_demand'], strict=True))
    (summary,) = summarize(found['on_demand'])
    assert summary.crops_share == pytest.approx(np.mean(shares))
    refused = [one for one in found['on_demand'] if not one.accepted]
    assert refused and all(one.refusal_kind for one in refused)
    assert sum(summary.refusals.values()) == len(refused)
    kinds = ', '.join(f'{count} {kind}' for kind, count in summary.refusals.items())
    assert f'auto refused: {kinds}.' in notes([summary])
