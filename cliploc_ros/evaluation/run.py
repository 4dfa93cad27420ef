# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All trials of all methods on all queries, on all cores; what is done survives Ctrl-C."""

import ctypes
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from itertools import batched
from typing import NamedTuple

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CliplocError
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.trials import Query, Result, run_trial

# What is lost at most by each core when a run is stopped.
_QUERIES_A_PART = 8
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RunError(CliplocError):
    """The run could not be ended."""


class _Part(NamedTuple):
    """One trial of a method on some queries, by their places in the input."""

    method: Method
    trial: int
    places: tuple[int, ...]


def run_methods(landmark_map: LandmarkMap, methods: Sequence[Method], queries: Sequence[Query],
                *, trials: int, workers: int = 1, done: Sequence[Result] = (),
                advance: Callable[[list[Result]], object] = lambda results: None) -> list[Result]:
    """Run methods on queries.

    Parameters
    ----------
    landmark_map : LandmarkMap
    methods : sequence of Method
        Those that draw nothing run one trial.
    queries : sequence of Query
    trials : int
    workers : int
        Processes; 1 works in this one. Results do not depend on it.
    done : sequence of Result
        What need not be run again.
    advance : callable, optional
        Called with the results of each part as it is done.

    Returns
    -------
    list of Result
        By method, trial and query.

    Raises
    ------
    RunError
        A worker died.
    """
    known = {(result.method, result.trial, result.query) for result in done}
    parts = list(_parts(methods, queries, trials, known))
    results = list(done)
    work = _in_processes if workers > 1 and len(parts) > 1 else _here
    for part_results in work(landmark_map, queries, parts, workers):
        results += part_results
        advance(part_results)
    order = {method.name: number for number, method in enumerate(methods)}
    return sorted(results, key=lambda one: (order[one.method], one.trial, one.query))


def count_searches(methods: Sequence[Method], queries: int, trials: int) -> int:
    """Return how many searches a run makes."""
    return sum(1 if method.draws_nothing else trials for method in methods) * queries


def _parts(methods: Sequence[Method], queries: Sequence[Query], trials: int,
           known: set[tuple[str, int, int]]) -> Iterator[_Part]:
    """Yield what is to be done, those that draw nothing first: they take longest."""
    for method in sorted(methods, key=lambda method: not method.draws_nothing):
        for trial in range(1 if method.draws_nothing else trials):
            places = [place for place, query in enumerate(queries)
                      if (method.name, trial, query.number) not in known]
            for some in batched(places, 1 if method.draws_nothing else _QUERIES_A_PART):
                yield _Part(method, trial, some)


def _here(landmark_map: LandmarkMap, queries: Sequence[Query], parts: Sequence[_Part],
          workers: int) -> Iterator[list[Result]]:
    _prepare(landmark_map, queries)
    for part in parts:
        yield _run_part(part)


def _in_processes(landmark_map: LandmarkMap, queries: Sequence[Query], parts: Sequence[_Part],
                  workers: int) -> Iterator[list[Result]]:
    # Spawned: forking a process that has run PyTorch's threads may hang.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn'),
                               initializer=_begin_worker, initargs=(landmark_map, queries))
    # The pool forgets its processes once it is told to end.
    processes = pool._processes
    futures: list[Future[list[Result]]] = []
    try:
        futures += [pool.submit(_run_part, part) for part in parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise RunError('a worker process died, of too little memory perhaps; what is done is '
                       'kept: go on with --resume, and fewer --workers') from error
    except BaseException:
        for process in [*processes.values()]:
            process.terminate()  # an exhaustive search may take minutes more
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_landmark_map: LandmarkMap
_queries: Sequence[Query]


def _begin_worker(landmark_map: LandmarkMap, queries: Sequence[Query]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    # Killed itself, the parent could end nothing any more: then the kernel does.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    _prepare(landmark_map, queries)


def _prepare(landmark_map: LandmarkMap, queries: Sequence[Query]) -> None:
    """Keep what all parts share, and compile before anything is timed."""
    global _landmark_map, _queries  # a pool's workers have no other memory
    _landmark_map, _queries = landmark_map, queries
    Relocalizer(landmark_map, RelocalizerOptions(matching='class', algorithm='bf')).warm_up()


def _run_part(part: _Part) -> list[Result]:
    queries = [_queries[place] for place in part.places]
    return run_trial(_landmark_map, part.method, part.trial, queries)
