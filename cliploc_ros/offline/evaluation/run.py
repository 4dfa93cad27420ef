# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare methods: run all trials on all cores or on a cluster, and write the files."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from itertools import batched, chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.files.log import Log
from cliploc_ros.files.parallel import run_tasks
from cliploc_ros.files.storage import make_folder, write_text
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.offline.evaluation import summary
from cliploc_ros.offline.evaluation.methods import Method
from cliploc_ros.offline.evaluation.report import PAGE, write_report
from cliploc_ros.offline.evaluation.trials import PosedQuery, Result, given_results, run_trial
from cliploc_ros.units import NS_PER_S

# Queries of a part: a stopped run loses the results of at most one part on each core.
_QUERIES_A_PART = 8
# Separates the name of a method from its number of iterations in a sweep.
_AT = '@'


class RunError(CliplocError):
    """A run is incomplete."""


class _Part(NamedTuple):
    """One trial of a method on some queries, which are given by their indices."""

    method: Method
    trial: int
    places: tuple[int, ...]


def run_methods(landmark_map: LandmarkMap, methods: Sequence[Method],
                queries: Sequence[PosedQuery],
                *, trials: int, workers: int = 1, scheduler: str = '',
                done: Sequence[Result] = (), layer: KeyframeLayer | None = None,
                noisy: Sequence[Sequence[PosedQuery]] = (),
                advance: Callable[[list[Result]], object] = lambda results: None) -> list[Result]:
    """Run methods on queries.

    Parameters
    ----------
    methods : sequence of Method
        A method that draws no samples runs one trial, unless the sensors have noise.
    workers, scheduler : int, str
        See cliploc_ros.files.parallel.run_tasks. The results do not depend on them.
    done : sequence of Result
        Results of an earlier run, which are not computed again.
    layer : KeyframeLayer, optional
        Keyframes of the map, which are used for queries with features.
    noisy : sequence of sequence of PosedQuery, optional
        For each trial, the queries with the noise of simulated sensors in that trial.
    advance : callable, optional
        Called with the results of each finished part.

    Returns
    -------
    list of Result
        By method, trial and query.

    Raises
    ------
    RunError
        Workers died repeatedly at some queries. The other queries are done.
    WorkersError
        From the workers.
    """
    known = {(result.method, result.trial, result.query) for result in done}
    # methods that draw no samples come first, since they take longest
    parts = [
        _Part(method, trial, places)
        for method in sorted(methods, key=lambda method: not method.draws_nothing)
        for trial in range(count_trials(method, trials, bool(noisy)))
        for places in batched((place for place, query in enumerate(queries)
                               if (method.name, trial, query.number) not in known),
                              1 if method.draws_nothing else _QUERIES_A_PART)]
    results, lost = list(done), []
    # a single part is done sooner than a process starts
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
        first = lost[0]
        raise RunError(f'workers died repeatedly at {len(lost)} of {len(parts)} parts, first at '
                       f'{first.method.name}, trial {first.trial}, queries {first.places[0]}-'
                       f'{first.places[-1]}; the others are done: continue with --resume and '
                       'fewer --workers')
    order = {method.name: number for number, method in enumerate(methods)}
    return sorted(results, key=lambda result: (order[result.method], result.trial, result.query))


def count_trials(method: Method, trials: int, are_noisy: bool = False) -> int:
    """Return the number of trials that differ: 1 without random samples and noisy sensors."""
    return trials if are_noisy or not method.draws_nothing else 1


@dataclass(frozen=True, eq=False)
class _MakeSearch:
    """Makes the function that runs a part, from the data that all parts share."""

    landmark_map: LandmarkMap
    queries: Sequence[Sequence[PosedQuery]]  # of each trial, or one sequence for all trials
    layer: KeyframeLayer | None = None

    def __call__(self) -> Callable[[_Part], list[Result]]:
        """Compile the kernels, since searches are timed, and return the function."""
        keyframes = None if self.layer is None else KeyframeLocalizer(self.layer)
        Relocalizer(self.landmark_map,
                    RelocalizerOptions(matching='class', algorithm='bf')).warm_up()

        def run(part: _Part) -> list[Result]:
            queries = self.queries[part.trial % len(self.queries)]
            return run_trial(self.landmark_map, part.method, part.trial,
                             [queries[place] for place in part.places], keyframes)
        return run


def compare_methods(landmark_map: LandmarkMap, queries: Sequence[PosedQuery],
                    methods: Sequence[Method], out: Path, *, sweep: Sequence[int] | None = (),
                    resume: bool = False, remarks: Sequence[str] = (),
                    given: Mapping[str, TimedPoses] = MappingProxyType({}),
                    about: Mapping[str, Any] = MappingProxyType({}), **running: Any
                    ) -> list[summary.Summary]:
    """Run methods, print the table, write all files to a folder; return their summaries.

    CliplocError: the run is incomplete or cannot be resumed, or a file cannot be written.

    Parameters
    ----------
    out : Path
        An existing folder.
    sweep : sequence of int, optional
        Further numbers of iterations of each sampling method, for a figure. None: no figures.
    resume : bool
        Continue an unfinished run.
    remarks : sequence of str
        Notes on the input, shown with the table.
    given : mapping of str to TimedPoses
        Poses of other programs by name, which become further rows of the table.
    about : mapping
        Input and options of the run, for run.json and the tables.
    running
        trials, workers, scheduler, layer, noisy: see run_methods.
    """
    others = [result for name, poses in given.items()
              for result in given_results(name, poses, queries)]
    swept = [replace(method, name=f'{method.name}{_AT}{count}',
                     options=replace(method.options, iterations=count))
             for method in methods if not method.draws_nothing
             for count in sweep or () if count != method.options.iterations]
    everything = [*methods, *swept]
    unfinished = out / 'unfinished.jsonl'
    if unfinished.exists() and not resume:
        raise OptionsError(f'{out} has an unfinished run; continue it with --resume, give '
                           f'another --out, or remove {unfinished}')
    total = len(queries) * sum(
        count_trials(method, running['trials'], bool(running.get('noisy')))
        for method in everything)
    run = describe(landmark_map, queries, everything, running['trials'], running.get('layer'),
                   running.get('noisy', ()))
    with closing(Log(unfinished, OptionsError, 'make room and continue with --resume')) as log:
        done = read_results(log, run)
        with tqdm(total=total, initial=len(done), unit='search', disable=None) as bar:
            def advance(results: list[Result]) -> None:
                log.append([result.as_dict() for result in results])
                bar.update(len(results))

            results = run_methods(landmark_map, everything, queries, done=done, advance=advance,
                                  **running)
        own = [result for result in results if _AT not in result.method]
        write_trajectories(out / 'trajectories', queries, own)
        shown = [*own, *others]
        summaries = summary.summarize(shown)
        rows = summary.table_rows(summaries)
        remarks = [*remarks, *summary.notes(summaries)]
        print('\n'.join(['', summary.as_text(rows), *remarks, '']), flush=True)
        about = {'version': _version(), 'queries': len(queries), 'landmarks': len(landmark_map),
                 'seed': methods[0].options.random_seed, **about}
        facts = list(chain.from_iterable(
            [(file, f'{name} {digest}') for file, digest in value.items()]
            if isinstance(value, dict) else [(name, str(value))] for name, value in about.items()))
        write_text(out / 'run.json', json.dumps(about, indent=1) + '\n')
        write_text(out / 'table.md', '\n\n'.join([summary.as_markdown(rows), *remarks, '\n'.join(
            f'- {name}: {value}' for name, value in facts)]) + '\n')
        write_text(out / 'results.json', summary.as_json(shown))
        write_text(out / 'table.tex', ''.join(
            f'% {name}: {value}\n' for name, value in facts) + summary.as_latex(rows))
        write_text(out / 'summary.csv', summary.as_csv(summaries, summary.relative_errors(
            shown, {query.number: query.map_from_camera for query in queries})))
        pictures = _draw(out, parts_of(landmark_map)[0].landmark_map, queries, results,
                         summaries, methods) if sweep is not None else []
        write_report(out, summaries, rows, remarks, pictures, facts)
        log.remove()
    print(f'results: {out.resolve() / PAGE}', flush=True)
    return summaries


def _version() -> str:
    try:
        return version('cliploc_ros')
    except PackageNotFoundError:  # it runs from its sources
        return 'unknown'


def read_results(log: Log, run: Mapping[str, Any]) -> list[Result]:
    """Return the results of an unfinished run, or begin the log of a new run.

    `run` comes from describe. OptionsError: the log is damaged or belongs to another run; the
    message names the differences.
    """
    entries, is_damaged = log.read()
    if not (entries or is_damaged):
        log.append(run)
        return []
    try:
        if is_damaged:
            raise ValueError('a line before the last one cannot be read')
        begun, *parts = entries
        differing = [key for key in run if begun.get(key) != run[key]]
        done = [Result(**fields) for part in parts for fields in part]
    except (ValueError, TypeError, AttributeError) as error:
        raise OptionsError(f'{log.path} is damaged; remove it to start again') from error
    if differing:
        raise OptionsError(f'{log.path} was begun with another {" and ".join(differing)}; '
                           'give the same, or remove it to start again')
    return done


def describe(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], methods: Sequence[Method],
             trials: int, layer: KeyframeLayer | None, noisy: Sequence[Sequence[PosedQuery]]
             ) -> dict[str, Any]:
    """Return the identity of a run as JSON values. Runs of equal identity have equal results."""
    asked = _digest(part for query in chain(queries, *noisy) for part in (
        *(part for seen in (*query.neighbours, query.observation) for part in (
            seen.similarities, seen.detections.bboxes_xyxy, seen.detections.class_ids,
            seen.up_in_camera, seen.odom_from_camera)), query.map_from_camera, query.number))
    world = _digest([landmark_map.landmark_ids, landmark_map.class_ids,
                     landmark_map.classes.members, landmark_map.centers, landmark_map.shapes])
    return {
        'queries': asked, 'map': world, 'trials': trials,
        'methods': {method.name: {name: str(value)
                                  for name, value in asdict(method.options).items()}
                    for method in methods},
        'keyframes': None if layer is None else {
            'digest': _digest([*(query.image.of_pass(is_thorough=False)[0].descriptors
                                 for query in queries if query.image is not None),
                               layer.map_from_camera, layer.points, layer.descriptors]),
            'methods': [method.name for method in methods if method.keyframes]}}


def _digest(parts: Iterable[object]) -> str:
    """Return a hash of arrays and other objects, whose repr is hashed."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray)
                      else repr(part).encode())
    return digest.hexdigest()


def _draw(out: Path, landmark_map: LandmarkMap, queries: Sequence[PosedQuery],
          results: Sequence[Result], summaries: Sequence[summary.Summary],
          methods: Sequence[Method]) -> list[Path]:
    try:
        from cliploc_ros.offline.evaluation.figures import draw_all
    except ImportError as error:
        print(f'no figures: {error}; install matplotlib', flush=True)
        return []
    # by sampling method and number of iterations
    sweep: dict[str, dict[int, summary.Summary]] = {}
    iterations = {method.name: method.options.iterations for method in methods
                  if not method.draws_nothing}
    for statistics in summary.summarize(results):
        name, _, count = statistics.method.partition(_AT)
        if name in iterations:
            sweep.setdefault(name, {})[int(count or iterations[name])] = statistics
    return draw_all(
        out, landmark_map, queries, [result for result in results if _AT not in result.method],
        summaries,
        {name: dict(sorted(counts.items())) for name, counts in sweep.items() if len(counts) > 1})


def write_trajectories(folder: Path, queries: Sequence[PosedQuery], results: Sequence[Result]
                       ) -> None:
    """Write ground_truth.txt, METHOD.txt and METHOD.accepted.txt of each method's first trial."""
    make_folder(folder)
    write_text(folder / 'ground_truth.txt', _tum_text(
        (query.observation.stamp_ns / NS_PER_S, query.map_from_camera) for query in queries))
    for method in dict.fromkeys(result.method for result in results):
        found = [(result, np.array(result.map_from_camera)) for result in results
                 if result.method == method and result.trial == 0 and result.solved]
        write_text(folder / f'{method}.txt',
                   _tum_text((result.timestamp, pose) for result, pose in found))
        write_text(folder / f'{method}.accepted.txt', _tum_text(
            (result.timestamp, pose) for result, pose in found if result.accepted))


def _tum_text(poses: Iterable[tuple[float, NDArray[np.float64]]]) -> str:
    lines = ['# timestamp tx ty tz qx qy qz qw']
    for timestamp, pose in sorted(poses, key=lambda stamped: stamped[0]):
        numbers = [*pose[:3, 3], *quaternion_from_transform(pose)]
        lines.append(' '.join([f'{timestamp:.6f}', *(f'{number:.9f}' for number in numbers)]))
    return '\n'.join(lines) + '\n'
