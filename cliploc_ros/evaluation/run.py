# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All trials of all methods on all queries, on all cores."""

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

# A stopped run loses at most this many queries of each core.
_QUERIES_A_PART = 8
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RunError(CliplocError):
    """The run could not be finished."""


class _Part(NamedTuple):
    """One trial of a method on some queries, given by their rows in the input."""

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
        A method that draws no samples runs one trial.
    queries : sequence of Query
    trials : int
    workers : int
        Number of processes; 1 uses this process. Results do not depend on it.
    done : sequence of Result
        Results of an earlier run, which are not run again.
    advance : callable, optional
        Called with the results of each finished part.

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
    finished = _in_processes(landmark_map, queries, parts, workers) \
        if workers > 1 and len(parts) > 1 else _here(landmark_map, queries, parts)
    for part_results in finished:
        results += part_results
        advance(part_results)
    order = {method.name: number for number, method in enumerate(methods)}
    return sorted(results, key=lambda one: (order[one.method], one.trial, one.query))


def count_searches(methods: Sequence[Method], queries: int, trials: int) -> int:
    """Return the number of searches of a run."""
    return sum(1 if method.draws_nothing else trials for method in methods) * queries


def _parts(methods: Sequence[Method], queries: Sequence[Query], trials: int,
           known: set[tuple[str, int, int]]) -> Iterator[_Part]:
    """Yield the parts to run; methods that draw no samples first, since they take longest."""
    for method in sorted(methods, key=lambda method: not method.draws_nothing):
        for trial in range(1 if method.draws_nothing else trials):
            places = [place for place, query in enumerate(queries)
                      if (method.name, trial, query.number) not in known]
            for some in batched(places, 1 if method.draws_nothing else _QUERIES_A_PART):
                yield _Part(method, trial, some)


def _here(landmark_map: LandmarkMap, queries: Sequence[Query], parts: Sequence[_Part]
          ) -> Iterator[list[Result]]:
    _prepare(landmark_map, queries)
    for part in parts:
        yield _run_part(part)


def _in_processes(landmark_map: LandmarkMap, queries: Sequence[Query], parts: Sequence[_Part],
                  workers: int) -> Iterator[list[Result]]:
    # spawned, since forking a process that has run PyTorch's threads may hang
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn'),
                               initializer=_begin_worker, initargs=(landmark_map, queries))
    # the pool forgets its processes when it shuts down
    processes = pool._processes
    futures: list[Future[list[Result]]] = []
    try:
        futures += [pool.submit(_run_part, part) for part in parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise RunError('a worker process died, perhaps out of memory; continue with --resume and '
                       'fewer --workers') from error
    except BaseException:
        for process in [*processes.values()]:
            process.terminate()  # an exhaustive search may take minutes
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_landmark_map: LandmarkMap
_queries: Sequence[Query]


def _begin_worker(landmark_map: LandmarkMap, queries: Sequence[Query]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers, so the kernel does
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    _prepare(landmark_map, queries)


def _prepare(landmark_map: LandmarkMap, queries: Sequence[Query]) -> None:
    """Keep what all parts share, and compile the kernels before a search is timed."""
    global _landmark_map, _queries  # a pool's workers have no other memory
    _landmark_map, _queries = landmark_map, queries
    Relocalizer(landmark_map, RelocalizerOptions(matching='class', algorithm='bf')).warm_up()


def _run_part(part: _Part) -> list[Result]:
    queries = [_queries[place] for place in part.places]
    return run_trial(_landmark_map, part.method, part.trial, queries)
