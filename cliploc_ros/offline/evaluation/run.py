# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare methods: run all trials on all cores or on a cluster, and write the files."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import batched, chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

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
from cliploc_ros.files.parallel import WorkersError, run_tasks
from cliploc_ros.files.storage import make_folder, write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.offline.evaluation import summary
from cliploc_ros.offline.evaluation.methods import Method
from cliploc_ros.offline.evaluation.trials import Result, find_misfit, given_results, run_trial
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.units import NS_PER_S

COMPARISON = 'report.html'
_TOP_VIEW = 'top_view'
# Columns of the table on the first screen: method, success, accepted, false accepts.
_BRIEF = (0, 1, 2, 5, 7)
CAPTIONS = {
    _TOP_VIEW: 'Top view of the map. A line joins each estimate of this method to the true pose.',
    'success_over_threshold': 'Share of poses, accepted or not, within a distance of the truth.',
    'precision_over_recall': 'Precision and recall for all thresholds of the confidence.',
    'success_over_iterations': 'Success over the number of iterations.'}
# Queries of a part, which one process runs, unless one localizer gets all queries of a trial.
_QUERIES_A_PART = 8
# Separates the name of a method from its number of iterations in a sweep.
_AT = '@'


# One trial of a method on some queries, which are given by their indices.
_Part = tuple[Method, int, tuple[int, ...]]


def run_methods(landmark_map: LandmarkMap, methods: Sequence[Method],
                queries: Sequence[PosedQuery],
                *, trials: int, workers: int = 1, scheduler: str = '',
                layer: KeyframeLayer | None = None,
                noisy: Sequence[Sequence[PosedQuery]] = ()) -> list[Result]:
    """Run methods on queries; show a progress bar on a terminal.

    Parameters
    ----------
    methods : sequence of Method
        A method that draws no samples runs one trial, unless the sensors have noise.
    workers, scheduler : int, str
        See cliploc_ros.files.parallel.run_tasks. The results do not depend on them.
    layer : KeyframeLayer, optional
        Keyframes of the map, which are used for queries with images.
    noisy : sequence of sequence of PosedQuery, optional
        For each trial, the queries with the noise of simulated sensors in that trial.

    Returns
    -------
    list of Result
        By method, trial and query.

    Raises
    ------
    WorkersError
        Workers cannot be started, or died repeatedly.
    """
    # parts that take longest come first
    parts = [
        (method, trial, places)
        for method in sorted(methods, key=lambda method: not method.draws_nothing)
        for trial in range(trials if noisy or not method.draws_nothing else 1)
        for places in batched(range(len(queries)), max(1, len(queries)) if method.accumulates
                              else 1 if method.draws_nothing else _QUERIES_A_PART)]
    results = list[Result]()
    # a single part is done sooner than a process starts
    workers = workers if len(parts) > 1 else 1
    make_search = partial(_make_search, landmark_map, noisy or [queries], layer)
    tasks = run_tasks(make_search, parts, workers=workers, scheduler=scheduler)
    total = sum(len(places) for _, _, places in parts)
    with closing(tasks) as finished, tqdm(total=total, unit='search', disable=None) as bar:
        for (method, trial, places), found in finished:
            if found is None:
                raise WorkersError(
                    f'workers died repeatedly at {method.name}, trial {trial}, queries '
                    f'{places[0]}-{places[-1]}; run again with fewer workers')
            results += found
            bar.update(len(found))
    order = {method.name: number for number, method in enumerate(methods)}
    return sorted(results, key=lambda result: (order[result.method], result.trial, result.query))


def _make_search(landmark_map: LandmarkMap, queries: Sequence[Sequence[PosedQuery]],
                 layer: KeyframeLayer | None) -> Callable[[_Part], list[Result]]:
    """Compile the kernels, since searches are timed; return the function that runs a part.

    `queries` are those of each trial, or one sequence for all trials.
    """
    keyframes = None if layer is None else KeyframeLocalizer(layer)
    Relocalizer(landmark_map, RelocalizerOptions(matching='class', algorithm='bf')).warm_up()

    def run(part: _Part) -> list[Result]:
        method, trial, places = part
        return run_trial(landmark_map, method, trial, [
            queries[trial % len(queries)][place] for place in places], keyframes)
    return run


def compare_methods(landmark_map: LandmarkMap, queries: Sequence[PosedQuery],
                    methods: Sequence[Method], out: Path, *, sweep: Sequence[int] | None = (),
                    remarks: Sequence[str] = (),
                    given: Mapping[str, TimedPoses] = MappingProxyType({}),
                    about: Mapping[str, Any] = MappingProxyType({}), **running: Any
                    ) -> list[summary.Summary]:
    """Run methods, print the table, write all files to a folder; return their summaries.

    CliplocError: the run is incomplete, or a file cannot be written.

    Parameters
    ----------
    out : Path
        An existing folder.
    sweep : sequence of int, optional
        Further numbers of iterations of each sampling method, for a figure. None: no figures.
    remarks : sequence of str
        Notes on the input, shown with the table.
    given : mapping of str to TimedPoses
        Poses of other programs by name, which become further rows of the table.
    about : mapping
        Input and options of the run, for run.json and the tables.
    running
        trials, workers, scheduler, layer, noisy: see run_methods.
    """
    of_others = {name: given_results(name, poses, queries) for name, poses in given.items()}
    swept = [replace(method, name=f'{method.name}{_AT}{count}',
                     options=replace(method.options, iterations=count))
             for method in methods if not method.draws_nothing
             for count in sweep or () if count != method.options.iterations]
    results = run_methods(landmark_map, [*methods, *swept], queries, **running)
    own = [result for result in results if _AT not in result.method]
    write_trajectories(out / 'trajectories', queries, own)
    shown = [*own, *chain.from_iterable(of_others.values())]
    summaries = summary.summarize(shown)
    rows = summary.table_rows(summaries)
    misfits = [find_misfit(its, queries, given[name]) for name, its in of_others.items()]
    remarks = [*remarks, *filter(None, misfits), *summary.notes(summaries)]
    if names := ', '.join(method.name for method in methods if method.accumulates):
        remarks.append(f'{names}: one localizer gets the queries in the order of their stamps, as '
                       'on a robot; its evidence about cameras and depth accumulates.')
    print('\n'.join(['', summary.as_text(rows), *remarks, '']), flush=True)
    about = {'version': _version(), 'queries': len(queries), 'landmarks': len(landmark_map),
             'seed': methods[0].options.random_seed, **about}
    facts = list(chain.from_iterable(
        [(file, f'{name} {digest}') for file, digest in value.items()]
        if isinstance(value, dict) else [(name, str(value))] for name, value in about.items()))
    write_text(out / 'run.json', json.dumps(about, indent=1) + '\n')
    write_text(out / 'table.md', '\n\n'.join([summary.as_markdown(rows), *remarks, '\n'.join(
        f'- {name}: {value}' for name, value in facts)]) + '\n')
    lines = ',\n'.join(json.dumps(vars(result)) for result in shown)
    write_text(out / 'results.json', f'[\n{lines}\n]\n')
    statistics = summary.csv_rows(summaries, summary.relative_errors(
        shown, {query.number: query.map_from_camera for query in queries}))
    write_text(out / 'table.tex', ''.join(
        f'% {name}: {value}\n' for name, value in facts) + summary.as_latex(statistics))
    write_text(out / 'summary.csv', summary.csv_text(statistics))
    pictures = _draw(out, parts_of(landmark_map)[0].landmark_map, queries, results,
                     summaries, methods) if sweep is not None else []
    _write_comparison(out, ' of '.join(['Evaluation', *filter(None, [about.get('map')])]),
                      summaries, rows, remarks, pictures, facts)
    print(f'results: {out.resolve() / COMPARISON}', flush=True)
    return summaries


def _version() -> str:
    try:
        return version('cliploc_ros')
    except PackageNotFoundError:  # it runs from its sources
        return 'unknown'


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


def _write_comparison(folder: Path, title: str, summaries: Sequence[summary.Summary],
                      rows: Sequence[Sequence[str]], remarks: Sequence[str],
                      pictures: Sequence[Path], about: Sequence[tuple[str, str]]) -> None:
    """Write the page of `evaluate`. It embeds the pictures, which are PNG files.

    `rows` are those of the table, its header first; `about` names and values of input and options.
    """
    best = summary.find_best(summaries)
    wrong, count = best.false_accepts(), best.errors_m.size
    equal = [each.method for each in summaries
             if each is not best and summary.compare(each, best).is_noise]
    of = f'has the highest success of {len(summaries)} methods ' if len(summaries) > 1 else ''
    said = html.verdict(f'{best.method} {of}on {len(best.queries)} images' + (
        f'; {", ".join(equal)} cannot be told apart' if equal else ''), not wrong)
    share = f'{100 * best.success(1.0):.0f} %'
    numbers = [(share, 'of the queries within 1 m of the truth', True)]
    if not best.is_given:
        errors, inside = best.of_accepted
        numbers += [
            (f'{int(best.accepted.sum())} of {count}', 'accepted', bool(best.accepted.any())),
            (str(wrong), 'accepted, but wrong by more than 1 m', not wrong),
            *([(f'{errors.max():.2f} m', 'worst error of an accepted pose', not wrong),
               (f'{inside} of {errors.size}', 'accepted poses in their 95 % ellipsoid', True)
               ] if errors.size else ())]
    drawn = {picture.stem: html.figure(picture.read_bytes(), CAPTIONS[picture.stem], picture.stem)
             for picture in pictures}
    head, *brief = [[row[column] for column in _BRIEF] for row in rows]
    top_view = drawn.pop(_TOP_VIEW, '')
    write_text(folder / COMPARISON, html.page(
        title,
        html.first_screen([said, html.tiles(numbers), html.table(head, brief)], [top_view]),
        html.fold('Complete table', html.table(rows[0], rows[1:]), *map(html.note, remarks)),
        html.fold('Input and options', html.table(('', ''), about)),
        html.fold('Figures', html.side_by_side(drawn.values()), is_open=True) if drawn else ''))


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
