# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Common parts of the studies: run tasks, tabulate and draw answers, and fit logistic models."""

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
from scipy.stats import chi2
from tqdm import tqdm

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.files.parallel import MakeWork, WorkersError, run_tasks
from cliploc_ros.files.storage import make_folder
from cliploc_ros.offline.evaluation.figures import JUDGED_COLORS, add_legend, new_axes, save_figure
from cliploc_ros.offline.evaluation.summary import wilson_interval

#: Errors below which a pose is a success [m].
SUCCESS_M = (0.1, 0.25, 0.5, 1.0)
#: Poses with greater errors can mislead a robot even if they are not false accepts.
FAR_M, FAR_DEG = 0.5, 20.0
_PRECISION = 0.99
# Bins of confidence, finer where poses are accepted
_BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0)
_FREEDOM = 6  # degrees of freedom of a pose
_MARKERS = 'osD^vP'
#: Confidences (n,), and whether each pose is correct (n,).
Judged = tuple[NDArray[np.float64], NDArray[np.bool_]]


def run_all(make_work: MakeWork, tasks: Sequence[Any], what: str, workers: int) -> list[Any]:
    """Return the outcomes of all tasks in order; show a progress bar.

    WorkersError: workers died at a task; the other outcomes alone would not be a fair sample.

    Parameters
    ----------
    make_work : MakeWork
        Makes the function that returns the sequence of outcomes of a task.
    what : str
        Name of the tasks in the plural.
    """
    found = {}
    with closing(run_tasks(make_work, tasks, workers=workers)) as results:
        for task, outcomes in tqdm(results, what, len(tasks), disable=None):
            if outcomes is None:
                raise WorkersError(f'workers died repeatedly at one of the {what}; use fewer '
                               '--workers')
            found[task] = outcomes
    return [outcome for task in tasks for outcome in found[task]]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The best pose of a request; errors are infinite if there is no pose or no true pose."""

    accepted: bool
    confidence: float
    error_m: float = inf
    error_deg: float = inf
    nees: float = inf
    min_confidence: float = RelocalizerOptions.min_confidence  #: Threshold of the acceptance

    @property
    def right(self) -> bool:
        """Return whether the pose is within 1 m of the truth."""
        return self.error_m < RIGHT_M


def judged(found: Relocalization, map_from_camera: NDArray[np.float64] | None) -> dict[str, Any]:
    """Return the fields of an answer to a query; a query outside the map has no true pose."""
    fields = {'accepted': found.accepted, 'confidence': float(found.confidence)}
    pose = found.map_from_camera
    if pose is None or map_from_camera is None:
        return fields
    error_m, error_deg = pose_error(pose, map_from_camera)
    return fields | {
        'error_m': float(error_m), 'error_deg': float(error_deg), 'nees': inf
        if found.covariance is None
        else float(normalized_square(pose, found.covariance, map_from_camera))}


def grouped[One](items: Iterable[One], by: Sequence[str]) -> dict[tuple[Any, ...], list[One]]:
    """Group items by the values of some fields."""
    groups: dict[tuple[Any, ...], list[One]] = {}
    for item in items:
        groups.setdefault(tuple(getattr(item, name) for name in by), []).append(item)
    return groups


def answer_table[One: Answer](answers: Iterable[One], by: Sequence[str],
                              **more: Callable[[list[One]], object]) -> str:
    """Return a Markdown table of answers, with a row for each group of equal fields.

    The intervals are those of the share of false accepts. The share of accepted poses within their
    95 % ellipsoid precedes the columns of ``more``.
    """
    rows = []
    for key, group in grouped(answers, by).items():
        errors_m = np.array([answer.error_m for answer in group])
        accepted = np.array([answer.accepted for answer in group])
        right, nees = errors_m < RIGHT_M, np.array([answer.nees for answer in group])
        judged = accepted & np.isfinite(nees)
        false, count = int((accepted & ~right).sum()), int(accepted.sum())
        rows.append([
            *key, len(group), ' '.join(f'{(errors_m < limit).mean():.2f}' for limit in SUCCESS_M),
            count, false, interval(false, count), interval(false, len(group), 4),
            sum(answer.accepted and (answer.error_m > FAR_M or answer.error_deg > FAR_DEG)
                for answer in group),
            f'{accepted[right].mean():.2f}' if right.any() else '',
            f'{within_ellipsoid(nees[judged]):.2f}' if judged.any() else '',
            *(column(group) for column in more.values())])
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
    """Return the share of poses within .5 m, and accepted_cell."""
    within = np.mean([answer.error_m < FAR_M for answer in answers])
    return f'{short(float(within))}; {accepted_cell(answers)}'


def accepted_cell(answers: Sequence[Answer]) -> str:
    """Return the numbers of accepted answers and of false accepts."""
    accepted = [answer for answer in answers if answer.accepted]
    return f'{len(accepted)} of {len(answers)}, {sum(not answer.right for answer in accepted)}'


def recall_cell(answers: Sequence[Answer]) -> str:
    """Return accepted_cell, and the recall of the correct answers."""
    accepted = [answer.accepted for answer in answers if answer.right]
    recall = short(float(np.mean(accepted))) if accepted else '-'
    return f'{accepted_cell(answers)}; {recall}'


def short(share: float) -> str:
    """Format a share with two digits and no leading zero."""
    return f'{share:.2f}'.removeprefix('0')


def print_section(heading: str, text: str) -> None:
    """Print a section of Markdown; script/document copies sections into pages by their heading."""
    print(f'## {heading}\n\n{text}\n')


def confidence_table(answers: Iterable[Answer], by: Sequence[str], thresholds: Sequence[float]
                     ) -> str:
    """Return a table of answers for several min_confidence, with the best recall at .99 precision.

    This recall does not depend on min_confidence, see best_recall.
    """
    return answer_table(
        [replace(answer, min_confidence=least, accepted=answer.confidence >= least)
         for answer in answers for least in thresholds], [*by, 'min_confidence'],
        best_recall=lambda group: f'{best_recall(*judged_of(group))[0]:.2f}')


def best_recall(likely: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the best recall with a precision of at least .99, and its threshold."""
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
    """Return the 95 % Wilson interval of a share."""
    low, high = wilson_interval(count, total) if total else (0.0, 1.0)
    return f'{low:.{digits}f} to {high:.{digits}f}'


@contextmanager
def draw(path: Path, xlabel: str, ylabel: str) -> Iterator[Axes]:
    """Yield axes to draw on, and write their figure to a file."""
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
    """Return the confidences of answers and whether they are correct, by a field."""
    return {name: judged_of(group) for (name,), group in grouped(answers, [field]).items()}


def judged_of(answers: Sequence[Answer]) -> Judged:
    """Return the confidences of answers and whether they are correct."""
    return (np.array([answer.confidence for answer in answers]),
            np.array([answer.right for answer in answers], dtype=np.bool_))


def fit_logistic(predictors: NDArray[np.float64], right: NDArray[np.bool_],
                 shrinkage: NDArray[np.float64], *, weights: NDArray[np.float64] | float = 1.0,
                 ceilings: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
    """Return the maximum-likelihood coefficients (k,) of a logistic model.

    Parameters
    ----------
    predictors : ndarray (n, k)
        The first column is 1.
    shrinkage : ndarray (k,)
        Inverse variances of the Gaussian prior, for predictors with a standard deviation of 1.
    weights, ceilings : ndarray (n,), optional
        Weights of the rows, and factors of their chances.
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


def draw_reliability(axes: Axes, judged: Mapping[str, tuple[NDArray[np.float64],
                                                            NDArray[np.bool_]]],
                     title: str = '') -> None:
    """Draw the share of correct poses over the confidence, with 95 % intervals.

    `judged` maps each name to confidences (n,) and a mask of the correct poses (n,).
    """
    if title:
        axes.set_title(title, fontsize=9)
    axes.plot([0, 1], [0, 1], color='#888888', linewidth=1.0, label='ideal')
    for number, (name, (confidence, right)) in enumerate(judged.items()):
        bins = np.clip(np.digitize(confidence, _BINS) - 1, 0, len(_BINS) - 2)
        color = JUDGED_COLORS[number % len(JUDGED_COLORS)]
        for row in np.unique(bins):
            chosen = bins == row
            share, mean = right[chosen].mean(), confidence[chosen].mean()
            low, high = wilson_interval(int(right[chosen].sum()), int(chosen.sum()))
            axes.errorbar(mean, share, np.maximum([[share - low], [high - share]], 0.0),
                          color=color, capsize=2, marker=_MARKERS[number % len(_MARKERS)],
                          markersize=5, linewidth=1.0,
                          label=f'{name} ({len(right)} poses)' if row == bins.min() else None)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))


def within_ellipsoid(squares: NDArray[np.float64], share: float = 0.95) -> float:
    """Return the share of poses within the confidence ellipsoids of a given probability."""
    return float((squares < chi2.ppf(share, _FREEDOM)).mean())
