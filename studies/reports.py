# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all studies share: runs of tasks, answers and their one table, figures, fits of odds."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.optimize import minimize
from tqdm import tqdm

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.files.parallel import MakeWork, run_tasks
from cliploc_ros.files.storage import make_folder
from cliploc_ros.offline.evaluation.figures import (
    add_legend,
    draw_reliability,
    new_axes,
    save_figure,
    within_ellipsoid,
)
from cliploc_ros.offline.evaluation.run import RunError
from cliploc_ros.offline.evaluation.summary import wilson_interval

#: Errors below which a pose is a success [m].
SUCCESS_M = (0.1, 0.25, 0.5, 1.0)
#: Errors of poses that lead a robot astray, though they may be no false accepts.
FAR_M, FAR_DEG = 0.5, 20.0
_PRECISION = 0.99
#: Confidences (n,), and whether each pose is right (n,).
Judged = tuple[NDArray[np.float64], NDArray[np.bool_]]


def run_all(make_work: MakeWork, tasks: Sequence[Any], what: str, workers: int) -> list[Any]:
    """Return the outcomes of all tasks, in their order; show a progress bar.

    RunError: workers died at a task: without its outcomes the rest would not be a fair sample.

    Parameters
    ----------
    make_work : MakeWork
        Makes the function that returns the outcomes of a task, a sequence.
    what : str
        Name of the tasks in the plural.
    """
    found = {}
    with closing(run_tasks(make_work, tasks, workers=workers)) as results:
        for task, outcomes in tqdm(results, what, len(tasks), disable=None):
            if outcomes is None:
                raise RunError(f'workers died again and again at one of the {what}; use fewer '
                               '--workers')
            found[task] = outcomes
    return [one for task in tasks for one in found[task]]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The best pose of one request; errors are infinite without one, and elsewhere."""

    accepted: bool
    confidence: float
    error_m: float = inf
    error_deg: float = inf
    nees: float = inf
    min_confidence: float = RelocalizerOptions.min_confidence  #: Of the acceptance

    @property
    def right(self) -> bool:
        """Return whether the pose is within 1 m of the truth."""
        return self.error_m < RIGHT_M


def judged(found: Relocalization, map_from_camera: NDArray[np.float64] | None) -> dict[str, Any]:
    """Return the fields of an answer to a query; a query without a true pose is elsewhere."""
    fields = {'accepted': found.accepted, 'confidence': float(found.confidence)}
    pose = found.map_from_camera
    if pose is None or map_from_camera is None:
        return fields
    error_m, error_deg = pose_error(pose, map_from_camera)
    return fields | {
        'error_m': float(error_m), 'error_deg': float(error_deg), 'nees': inf
        if found.covariance is None
        else float(normalized_square(pose, found.covariance, map_from_camera))}


def grouped[One](some: Iterable[One], by: Sequence[str]) -> dict[tuple[Any, ...], list[One]]:
    """Return things in groups of equal fields."""
    groups: dict[tuple[Any, ...], list[One]] = {}
    for one in some:
        groups.setdefault(tuple(getattr(one, name) for name in by), []).append(one)
    return groups


def answer_table[One: Answer](answers: Iterable[One], by: Sequence[str],
                              **more: Callable[[list[One]], object]) -> str:
    """Return what became of requests, as Markdown: a row for each group of equal fields.

    The intervals are of the share of false accepts. Before the columns of ``more`` comes the share
    of accepted poses within their 95 % ellipsoid.
    """
    rows = []
    for key, its in grouped(answers, by).items():
        errors_m = np.array([one.error_m for one in its])
        accepted = np.array([one.accepted for one in its])
        right, nees = errors_m < RIGHT_M, np.array([one.nees for one in its])
        judged = accepted & np.isfinite(nees)
        false, count = int((accepted & ~right).sum()), int(accepted.sum())
        rows.append([
            *key, len(its), ' '.join(f'{(errors_m < limit).mean():.2f}' for limit in SUCCESS_M),
            count, false, interval(false, count), interval(false, len(its), 4),
            sum(one.accepted and (one.error_m > FAR_M or one.error_deg > FAR_DEG) for one in its),
            f'{accepted[right].mean():.2f}' if right.any() else '',
            f'{within_ellipsoid(nees[judged]):.2f}' if judged.any() else '',
            *(column(its) for column in more.values())])
    return table([*by, 'n', f'within {" ".join(f"{limit:g}" for limit in SUCCESS_M)} m',
                  'accepted', 'false', '95 % of accepted', '95 % of n',
                  f'{FAR_M:g} m or {FAR_DEG:g} deg off', 'recall', 'in 95 %',
                  *(name.replace('_', ' ') for name in more)], rows)


def crossed_table[One: Answer](answers: Iterable[One], row: str, column: str,
                               cell: Callable[[list[One]], str]) -> str:
    """Return a Markdown table with a row and a column for each value of two fields.

    Parameters
    ----------
    cell : callable
        Returns the text for the answers that have both values; see success_cell.
    """
    groups = grouped(answers, [row, column])
    rows, columns = (list(dict.fromkeys(key[index] for key in groups)) for index in (0, 1))
    return table([row, *columns], [
        [name, *(cell(groups[name, of]) if (name, of) in groups else '' for of in columns)]
        for name in rows])


def success_cell(answers: Sequence[Answer]) -> str:
    """Return the share within .5 m; how many are accepted, and of these false."""
    within = np.mean([answer.error_m < FAR_M for answer in answers])
    return f'{short(float(within))}; {accepted_cell(answers)}'


def accepted_cell(answers: Sequence[Answer]) -> str:
    """Return how many answers are accepted, and of these false."""
    accepted = [answer for answer in answers if answer.accepted]
    return f'{len(accepted)} of {len(answers)}, {sum(not answer.right for answer in accepted)}'


def recall_cell(answers: Sequence[Answer]) -> str:
    """Return accepted_cell, and the share of right answers that is accepted."""
    accepted = [answer.accepted for answer in answers if answer.right]
    recall = short(float(np.mean(accepted))) if accepted else '-'
    return f'{accepted_cell(answers)}; {recall}'


def short(share: float) -> str:
    """Return a share with two digits and no leading zero."""
    return f'{share:.2f}'.removeprefix('0')


def print_section(heading: str, text: str) -> None:
    """Print a section of Markdown; script/document copies sections into pages by their heading."""
    print(f'## {heading}\n\n{text}\n')


def confidence_table(answers: Iterable[Answer], by: Sequence[str], thresholds: Sequence[float]
                     ) -> str:
    """Return what several values of min_confidence accept, and the best recall at .99 precision.

    The recall is that of any threshold, see best_recall.
    """
    return answer_table(
        [replace(one, min_confidence=least, accepted=one.confidence >= least) for one in answers
         for least in thresholds], [*by, 'min_confidence'],
        best_recall=lambda its: f'{best_recall(*judged_of(its))[0]:.2f}')


def best_recall(likely: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the best recall of any threshold with a precision of .99, and the threshold."""
    order = np.argsort(-likely, kind='stable')
    hits = np.cumsum(right[order])
    precise = np.nonzero(hits >= _PRECISION * np.arange(1, len(hits) + 1))[0]
    if not len(precise):
        return 0.0, 1.0
    return float(hits[precise[-1]] / hits[-1]), float(likely[order[precise[-1]]])


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ['---'] * len(columns), *rows]
    return '\n'.join(f'| {" | ".join(map(str, cells))} |' for cells in lines)


def interval(count: float, total: int, digits: int = 2) -> str:
    """Return the 95 % interval of a share, after Wilson."""
    low, high = wilson_interval(count, total) if total else (0.0, 1.0)
    return f'{low:.{digits}f} to {high:.{digits}f}'


@contextmanager
def draw(path: Path, xlabel: str, ylabel: str) -> Iterator[Axes]:
    """Write what is drawn on the axes to a file."""
    make_folder(path.parent)
    figure, axes = new_axes(xlabel, ylabel)
    yield axes
    add_legend(figure)
    print(f'wrote {save_figure(figure, path)}')


def draw_judged(path: Path, title: str, judged: Mapping[str, Judged]) -> None:
    """Draw a reliability diagram."""
    with draw(path, 'confidence', f'share of poses within {RIGHT_M:g} m') as axes:
        draw_reliability(axes, judged)
        axes.set_title(title, fontsize=9)


def judged_by(answers: Iterable[Answer], field: str) -> dict[str, Judged]:
    """Return the confidences of answers, and if they are right, by a field."""
    return {name: judged_of(its) for (name,), its in grouped(answers, [field]).items()}


def judged_of(answers: Sequence[Answer]) -> Judged:
    """Return the confidences of answers, and if they are right."""
    return (np.array([answer.confidence for answer in answers]),
            np.array([answer.right for answer in answers], dtype=np.bool_))


def fit_logistic(predictors: NDArray[np.float64], right: NDArray[np.bool_],
                 shrinkage: NDArray[np.float64], *, weights: NDArray[np.float64] | float = 1.0,
                 ceilings: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
    """Return the coefficients (k,) of a logistic model, of maximum likelihood.

    Parameters
    ----------
    predictors : ndarray (n, k)
        The first is 1.
    shrinkage : ndarray (k,)
        Inverse variances of the Gaussian prior, for predictors of deviation 1.
    weights, ceilings : ndarray (n,), optional
        Of the rows; a row's chance counts below its ceiling.
    """
    scales = np.append(1.0, np.maximum(predictors[:, 1:].std(axis=0), 1e-6))

    def loss(scaled: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logistic = chance(predictors, scaled / scales)
        chances = np.clip(ceilings * logistic, 1e-9, 1.0 - 1e-9)
        slopes = (1.0 - logistic) * np.where(right, 1.0, -chances / (1.0 - chances))
        shrunk = shrinkage * scaled
        return (float(0.5 * shrunk @ scaled - (weights * np.log(
            np.where(right, chances, 1.0 - chances))).sum()),
            shrunk - (weights * slopes) @ predictors / scales)

    return np.asarray(minimize(loss, np.zeros(len(scales)), jac=True, method='BFGS').x / scales)


def chance(predictors: NDArray[np.float64], coefficients: NDArray[np.float64]
           ) -> NDArray[np.float64]:
    """Return the logistic chance (n,) of predictors (n, k)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(predictors @ coefficients, -50.0, 50.0))))
