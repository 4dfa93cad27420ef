# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All trials of all methods on all queries, on all cores or on a cluster."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import batched
from typing import Any, NamedTuple

from tqdm import tqdm

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CliplocError
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.trials import Query, Result, run_trial
from cliploc_ros.files.parallel import MakeWork, run_tasks

# A stopped run loses at most this many queries of each core.
_QUERIES_A_PART = 8
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RunError(CliplocError):
    """The run could not be finished."""


def run_all(make_search: MakeWork, tasks: Sequence[Any], what: str, workers: int) -> list[Any]:
    """Return the outcomes of all tasks, in their order; show a progress bar.

    Parameters
    ----------
    make_search : MakeWork
        Makes the function that returns the outcomes of a task, a sequence.
    what : str
        Name of the tasks in the plural.

    Raises
    ------
    RunError
        Workers died at a task: without its outcomes the rest would not be a fair sample.
    """
    found = {}
    with closing(run_tasks(make_search, tasks, workers=workers)) as results:
        for task, outcomes in tqdm(results, what, len(tasks), disable=None):
            if outcomes is None:
                raise RunError(f'workers died again and again at one of the {what}; use fewer '
                               '--workers')
            found[task] = outcomes
    return [one for task in tasks for one in found[task]]


class _Part(NamedTuple):
    """One trial of a method on some queries, given by their rows in the input."""

    method: Method
    trial: int
    places: tuple[int, ...]

    @property
    def name(self) -> str:
        """Return what it is, for a message."""
        return f'{self.method.name}, trial {self.trial}, rows {self.places[0]}-{self.places[-1]}'


def run_methods(landmark_map: LandmarkMap, methods: Sequence[Method], queries: Sequence[Query],
                *, trials: int, workers: int = 1, scheduler: str = '',
                done: Sequence[Result] = (), layer: KeyframeLayer | None = None,
                noisy: Sequence[Sequence[Query]] = (),
                advance: Callable[[list[Result]], object] = lambda results: None) -> list[Result]:
    """Run methods on queries.

    Parameters
    ----------
    methods : sequence of Method
        A method that draws no samples runs one trial, unless the trials have noise of their own.
    workers, scheduler : int, str
        See cliploc_ros.files.parallel.run_tasks. Results do not depend on them.
    done : sequence of Result
        Results of an earlier run, which are not run again.
    layer : KeyframeLayer, optional
        Keyframes of the map, for methods that use them and queries with features.
    noisy : sequence of sequence of Query, optional
        For each trial the same queries with other noise of simulated sensors.
    advance : callable, optional
        Called with the results of each finished part.

    Returns
    -------
    list of Result
        By method, trial and query.

    Raises
    ------
    RunError
        Workers died again and again at some queries; all others are done.
    WorkersError
        From the workers.
    """
    known = {(result.method, result.trial, result.query) for result in done}
    # those that draw no samples first, since they take longest
    parts = [
        _Part(method, trial, places)
        for method in sorted(methods, key=lambda method: not method.draws_nothing)
        for trial in range(count_trials(method, trials, bool(noisy)))
        for places in batched((place for place, query in enumerate(queries)
                               if (method.name, trial, query.number) not in known),
                              1 if method.draws_nothing else _QUERIES_A_PART)]
    results, lost = list(done), []
    # a few queries are done sooner than a process starts
    workers = workers if len(parts) > 1 else 1
    make_search = _MakeSearch(landmark_map, noisy or [queries], layer)
    with closing(run_tasks(make_search, parts, workers=workers, scheduler=scheduler)) as finished:
        for part, found in finished:
            if found is None:
                lost.append(part)
            else:
                results += found
                advance(found)
    if lost:
        raise RunError(f'workers died again and again at {len(lost)} of {len(parts)} parts, first '
                       f'at {lost[0].name}; the others are done: continue with --resume and fewer '
                       '--workers')
    order = {method.name: number for number, method in enumerate(methods)}
    return sorted(results, key=lambda one: (order[one.method], one.trial, one.query))


def count_trials(method: Method, trials: int, are_noisy: bool = False) -> int:
    """Return how many trials of a method differ, where its sensors have noise or not."""
    return trials if are_noisy or not method.draws_nothing else 1


@dataclass(frozen=True, eq=False)
class _MakeSearch:
    """Makes the function that runs a part; holds what all parts share."""

    landmark_map: LandmarkMap
    queries: Sequence[Sequence[Query]]  # of each trial, or of all of them
    layer: KeyframeLayer | None = None

    def __call__(self) -> Callable[[_Part], list[Result]]:
        """Return the function, after the kernels are compiled: searches are timed."""
        keyframes = None if self.layer is None else KeyframeLocalizer(self.layer)
        Relocalizer(self.landmark_map,
                    RelocalizerOptions(matching='class', algorithm='bf')).warm_up()

        def run(part: _Part) -> list[Result]:
            queries = self.queries[part.trial % len(self.queries)]
            return run_trial(self.landmark_map, part.method, part.trial,
                             [queries[place] for place in part.places], keyframes)
        return run
