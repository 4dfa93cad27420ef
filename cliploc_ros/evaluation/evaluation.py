# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation, from its queries to its table, files and figures."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.datasets.queries import QueryFrame
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.output import write_text, write_trajectories
from cliploc_ros.evaluation.paper_table import (
    as_csv,
    as_json,
    as_markdown,
    as_text,
    notes,
    table_rows,
)
from cliploc_ros.evaluation.run import count_trials, run_methods
from cliploc_ros.evaluation.summary import Summary, summarize
from cliploc_ros.evaluation.trials import Query, Result
from cliploc_ros.files.log import Log

# Separates the name of a method from a number of iterations.
_AT = '@'


def compare_methods(landmark_map: LandmarkMap, queries: Sequence[Query],
                    methods: Sequence[Method], out: Path, *, sweep: Sequence[int] = (),
                    resume: bool = False, figures: bool = True,
                    frames: Sequence[QueryFrame] = (), **running: Any) -> list[Summary]:
    """Run methods, print the table, write all files to a folder; return their summaries.

    Parameters
    ----------
    out : Path
        An existing folder.
    sweep : sequence of int
        Further numbers of iterations for each sampling method, for a figure.
    resume : bool
        Continue an unfinished run.
    frames : sequence of QueryFrame
        Frames of the query file, for the times of detector and CLIP.
    running
        trials, workers, scheduler, layer, noisy: see run_methods.

    Raises
    ------
    CliplocError
        The run cannot be resumed, or a file cannot be written.
    """
    swept = [replace(one, name=f'{one.name}{_AT}{count}',
                     options=replace(one.options, iterations=count))
             for one in methods if not one.draws_nothing
             for count in sweep if figures and count != one.options.iterations]
    everything = [*methods, *swept]
    unfinished = out / 'unfinished.jsonl'
    if unfinished.exists() and not resume:
        raise OptionsError(f'{out} holds an unfinished run; continue with --resume, give '
                           f'another --out, or remove {unfinished}')
    total = len(queries) * sum(
        count_trials(one, running['trials'], bool(running.get('noisy'))) for one in everything)
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
        own = [one for one in results if _AT not in one.method]
        summaries = summarize(own)
        rows = table_rows(summaries)
        write_trajectories(out / 'trajectories', queries, own)
        remarks = notes(summaries)
        print('\n'.join(['', as_text(rows), *remarks, '']), flush=True)
        write_text(out / 'table.md', '\n\n'.join([as_markdown(rows), *remarks]) + '\n')
        write_text(out / 'results.json', as_json(own))
        write_text(out / 'summary.csv', as_csv(summaries))
        if figures:
            _draw(out, parts_of(landmark_map)[0].landmark_map, queries, own, summaries,
                  _by_count(summarize(results), methods), frames)
        log.remove()
    print(f'results: {out.resolve()}', flush=True)
    return summaries


def read_results(log: Log, run: Mapping[str, Any]) -> list[Result]:
    """Return the results of an unfinished run, or begin the log of a new one.

    Parameters
    ----------
    run : mapping
        Description of the run, as JSON keeps it.

    Raises
    ------
    OptionsError
        The log belongs to another run (names what differs), or is damaged.
    """
    entries, is_damaged = log.read()
    if not (entries or is_damaged):
        log.append(run)
        return []
    try:
        if is_damaged:
            raise ValueError('a line in its middle cannot be read')
        begun, *parts = entries
        differing = [key for key in run if begun.get(key) != run[key]]
        done = [Result(**fields) for part in parts for fields in part]
    except (ValueError, TypeError, AttributeError) as error:
        raise OptionsError(f'{log.path}: is damaged; remove it to start again') from error
    if differing:
        raise OptionsError(f'{log.path}: was begun with another {" and ".join(differing)}; '
                           'give the same, or remove it to start again')
    return done


def describe(landmark_map: LandmarkMap, queries: Sequence[Query], methods: Sequence[Method],
             trials: int, layer: KeyframeLayer | None, noisy: Sequence[Sequence[Query]]
             ) -> dict[str, Any]:
    """Return what identifies a run, as JSON keeps it."""
    digest = hashlib.sha256()
    for query in chain(queries, *noisy):
        for one in (*query.neighbours, query.observation):
            for part in (one.similarities, one.detections.bboxes_xyxy):
                digest.update(np.ascontiguousarray(part).tobytes())
            digest.update(repr((one.detections.class_ids, one.up_in_camera,
                                one.odom_from_camera)).encode())
        digest.update(np.ascontiguousarray(query.map_from_camera).tobytes())
        digest.update(repr(query.number).encode())
    world = hashlib.sha256(repr((landmark_map.landmark_ids, landmark_map.class_ids,
                                 landmark_map.classes.members.tolist(),
                                 landmark_map.centers.tolist(),
                                 landmark_map.shapes.tolist())).encode())
    run = {'queries': digest.hexdigest(), 'map': world.hexdigest(), 'trials': trials,
           'methods': {one.name: {name: str(value) for name, value in asdict(one.options).items()}
                       for one in methods}, 'keyframes': None}
    if layer is not None:
        digest = hashlib.sha256()
        for query in queries:
            if query.image is not None:
                digest.update(query.image.features.descriptors.tobytes())
        for array in (layer.map_from_camera, layer.points, layer.descriptors):
            digest.update(np.ascontiguousarray(array).tobytes())
        run['keyframes'] = {'digest': digest.hexdigest(),
                            'methods': [one.name for one in methods if one.keyframes]}
    return run


def _draw(out: Path, landmark_map: LandmarkMap, queries: Sequence[Query],
          results: Sequence[Result], summaries: Sequence[Summary],
          sweep: dict[str, dict[int, Summary]], frames: Sequence[QueryFrame]) -> None:
    try:
        from cliploc_ros.evaluation.figures import draw_all
    except ImportError as error:
        print(f'no figures: {error}; install matplotlib', flush=True)
        return
    observing = {stage: np.array([getattr(frame, name) for frame in frames])
                 for stage, name in (('detector', 'detector_ms'), ('CLIP', 'clip_ms'))}
    draw_all(out, landmark_map, queries, results, summaries, sweep,
             {stage: float(np.nanmean(times)) for stage, times in observing.items()
              if np.isfinite(times).any()})


def _by_count(summaries: Sequence[Summary], methods: Sequence[Method]
              ) -> dict[str, dict[int, Summary]]:
    """Return the summaries of each sampling method, by their number of iterations."""
    counts: dict[str, dict[int, Summary]] = {}
    iterations = {one.name: one.options.iterations for one in methods if not one.draws_nothing}
    for one in summaries:
        name, _, count = one.method.partition(_AT)
        if name in iterations:
            counts.setdefault(name, {})[int(count or iterations[name])] = one
    return {name: dict(sorted(found.items())) for name, found in counts.items()
            if len(found) > 1}
