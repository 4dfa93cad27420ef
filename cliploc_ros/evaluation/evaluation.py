# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation, from its queries to its table, files and figures."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
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
from cliploc_ros.evaluation.journal import Journal
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

_JOURNAL = 'unfinished.jsonl'
_TRAJECTORIES = 'trajectories'
# Separates the name of a method from a number of iterations.
_AT = '@'


@dataclass(frozen=True)
class Evaluation:
    """Queries, their map, and the folder for the results.

    Parameters
    ----------
    out : Path
        An existing folder.
    trials, workers, scheduler, layer, noisy
        See run_methods.
    """

    landmark_map: LandmarkMap
    queries: Sequence[Query]
    out: Path
    trials: int
    workers: int
    scheduler: str = ''
    layer: KeyframeLayer | None = None
    noisy: Sequence[Sequence[Query]] = ()

    def compare(self, methods: Sequence[Method], *, sweep: Sequence[int] = (),
                resume: bool = False, figures: bool = True, frames: Sequence[QueryFrame] = ()
                ) -> list[Summary]:
        """Run methods, print the table, and write all files.

        Parameters
        ----------
        sweep : sequence of int
            Further numbers of iterations for each sampling method, for a figure.
        resume : bool
            Continue an unfinished run.
        figures : bool
            Whether to draw.
        frames : sequence of QueryFrame
            Frames of the query file, for the times of detector and CLIP.

        Returns
        -------
        list of Summary
            Of the methods.

        Raises
        ------
        CliplocError
            The run cannot be resumed, or a file cannot be written.
        """
        everything = [*methods, *_swept(methods, sweep if figures else ())]
        results = self._run(everything, resume)
        own = [one for one in results if _AT not in one.method]
        summaries = summarize(own)
        rows = table_rows(summaries)
        write_trajectories(self.out / _TRAJECTORIES, self.queries, own)
        remarks = notes(summaries)
        print('\n'.join(['', as_text(rows), *remarks, '']), flush=True)
        write_text(self.out / 'table.md', '\n\n'.join([as_markdown(rows), *remarks]) + '\n')
        write_text(self.out / 'results.json', as_json(own))
        write_text(self.out / 'summary.csv', as_csv(summaries))
        if figures:
            self._draw(own, summaries, _by_count(summarize(results), methods), frames)
        Journal(self.out / _JOURNAL).remove()
        print(f'results: {self.out.resolve()}', flush=True)
        return summaries

    def _run(self, methods: Sequence[Method], resume: bool) -> list[Result]:
        run = self._describe(methods)
        journal = Journal(self.out / _JOURNAL)
        if journal.exists and not resume:
            raise OptionsError(f'{self.out} holds an unfinished run; continue with --resume, give '
                               f'another --out, or remove {self.out / _JOURNAL}')
        done = journal.read(run) if journal.exists else []
        total = len(self.queries) * sum(count_trials(one, self.trials, bool(self.noisy))
                                        for one in methods)
        with (journal.writing(run, done),
              tqdm(total=total, initial=len(done), unit='search', disable=None) as bar):
            def advance(results: list[Result]) -> None:
                journal.add(results)
                bar.update(len(results))

            return run_methods(self.landmark_map, methods, self.queries, trials=self.trials,
                               workers=self.workers, scheduler=self.scheduler, done=done,
                               layer=self.layer, noisy=self.noisy, advance=advance)

    def _describe(self, methods: Sequence[Method]) -> dict[str, Any]:
        """Return what identifies this run, as JSON keeps it."""
        digest = hashlib.sha256()
        for query in chain(self.queries, *self.noisy):
            for one in (*query.neighbours, query.observation):
                for part in (one.similarities, one.detections.bboxes_xyxy):
                    digest.update(np.ascontiguousarray(part).tobytes())
                digest.update(repr((one.detections.class_ids, one.up_in_camera,
                                    one.odom_from_camera)).encode())
            digest.update(np.ascontiguousarray(query.map_from_camera).tobytes())
            digest.update(repr(query.number).encode())
        world = hashlib.sha256(repr((self.landmark_map.landmark_ids, self.landmark_map.class_ids,
                                     self.landmark_map.classes.members.tolist(),
                                     self.landmark_map.centers.tolist(),
                                     self.landmark_map.shapes.tolist())).encode())
        return {'queries': digest.hexdigest(), 'map': world.hexdigest(), 'trials': self.trials,
                'methods': {one.name: {name: str(value) for name, value
                                       in asdict(one.options).items()} for one in methods},
                'keyframes': self._describe_keyframes(methods)}

    def _describe_keyframes(self, methods: Sequence[Method]) -> dict[str, Any] | None:
        if self.layer is None:
            return None
        digest = hashlib.sha256()
        for query in self.queries:
            if query.image is not None:
                digest.update(query.image.features.descriptors.tobytes())
        for part in (self.layer.map_from_camera, self.layer.points, self.layer.descriptors):
            digest.update(np.ascontiguousarray(part).tobytes())
        return {'digest': digest.hexdigest(),
                'methods': [one.name for one in methods if one.keyframes]}

    def _draw(self, results: Sequence[Result], summaries: Sequence[Summary],
              sweep: dict[str, dict[int, Summary]], frames: Sequence[QueryFrame]) -> None:
        try:
            from cliploc_ros.evaluation.figures import draw_all
        except ImportError as error:
            print(f'no figures: {error}; install matplotlib', flush=True)
            return
        observing = {stage: np.array([getattr(frame, name) for frame in frames])
                     for stage, name in (('detector', 'detector_ms'), ('CLIP', 'clip_ms'))}
        own = parts_of(self.landmark_map)[0].landmark_map  # that of the true poses
        draw_all(self.out, own, self.queries, results, summaries, sweep,
                 {stage: float(np.nanmean(times)) for stage, times in observing.items()
                  if np.isfinite(times).any()})


def _swept(methods: Sequence[Method], counts: Sequence[int]) -> list[Method]:
    return [replace(one, name=f'{one.name}{_AT}{count}',
                    options=replace(one.options, iterations=count))
            for one in methods if not one.draws_nothing
            for count in counts if count != one.options.iterations]


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
