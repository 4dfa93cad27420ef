# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fitting the confidence: ``python -m cliploc_ros.evaluation.calibration --help``.

Each frame is localized as it is, with boxes dropped or invented, by classes alone, and in a map
whose objects have exchanged places, where every pose is wrong. The coefficients maximize the
likelihood of what turned out right. For the report, they are fitted on half of the places and
tested on the other half, both ways; neighbouring frames are always in the same half. The
coefficients printed in the end are fitted on all frames.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.attitude import tilt_handicaps
from cliploc_ros.core.acceptance.confidence import DEFAULT, Calibration, Support, confidences
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.leaders import MAX_DISTINCT
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trials import Query, make_queries
from cliploc_ros.evaluation.troubles import (
    Change,
    drop_detections,
    exchange_landmarks,
    invent_detections,
)

RIGHT_M = 1.0
_FIELDS = ('score', 'misfit', 'likeness', 'same_class', 'unlabelled', 'unexplained')
# Support must not count against a pose, whatever a small data set says.
_BOUNDS = ((0, None), (None, 0), (0, None), (0, None), (0, None), (None, 0), (None, None))
_KNEES = (0.0, 0.5, 1.0, 1.5, 2.0)
_MOST_SLOPE = 3.0
_RIDGE = 1e-4
# Weight of frames at a place that the map does not show. A guess: robots rarely start there.
_ELSEWHERE = 0.01


@dataclass(frozen=True)
class Round:
    """One pass over all frames.

    Parameters
    ----------
    weight : float
        Weight of a frame in the fit.
    matching : str
    change : Change
        Simulated error of map or detections.
    level : float
        Its level; 0 changes nothing.
    is_elsewhere : bool
        Whether the map shows another place, so that every pose is wrong.
    """

    weight: float
    matching: str = 'hybrid'
    change: Change = drop_detections
    level: float = 0.0
    is_elsewhere: bool = False

    @property
    def is_whole(self) -> bool:
        """Return whether labels are matched and nothing is changed; the report is on these."""
        return self.matching == 'hybrid' and self.level == 0.0


# Simulated errors provide wrong poses, but are not the task: they weigh less. The weights are
# guesses.
WHOLE = Round(1.0)
ROUNDS = (WHOLE, *(Round(0.1, level=level) for level in (0.3, 0.3, 0.5, 0.5)),
          Round(0.1, change=invent_detections, level=0.5),
          *(Round(0.1, 'class', level=level) for level in (0.0, 0.3)),
          *(Round(_ELSEWHERE, matching, exchange_landmarks, 1.0, True)
            for matching in ('hybrid', 'hybrid', 'hybrid', 'class', 'class')))


@dataclass(frozen=True)
class Case:
    """The hypotheses of a search, and which of them are right.

    Parameters
    ----------
    place : str
        Frames of one place stay in one half.
    round : Round
    supports : tuple of m Support
    poses : ndarray (m, 4, 4)
    right : ndarray (m,) of bool
    handicaps : ndarray (m,)
        See confidences.
    near : float
        See Evidence; of the first hypothesis.
    """

    place: str
    round: Round
    supports: tuple[Support, ...]
    poses: NDArray[np.float64]
    right: NDArray[np.bool_]
    handicaps: NDArray[np.float64]
    near: float = 1.0


def judge(found: Relocalization, map_from_camera: NDArray[np.float64], place: str,
          of_round: Round = WHOLE) -> Case:
    """Return the hypotheses of a search, compared with the true pose (4, 4)."""
    poses = np.array([one.map_from_camera for one in found.hypotheses])
    errors = np.array([pose_error(pose, map_from_camera)[0] for pose in poses])
    return Case(place, of_round, tuple(one.support for one in found.hypotheses), poses,
                (errors < RIGHT_M) & (not of_round.is_elsewhere),
                tilt_handicaps(poses, RelocalizerOptions.tilt_deviation_deg),
                1.0 if found.evidence is None else found.evidence.near)


def collect(landmark_map: LandmarkMap, queries: Sequence[Query], places: Sequence[str],
            seed: int = 0) -> Iterator[Case | None]:
    """Localize frames in all rounds, see ROUNDS.

    Parameters
    ----------
    landmark_map : LandmarkMap
    queries : sequence of Query
    places : sequence of str
        Place of each query.
    seed : int
        Seed of the simulated errors.

    Yields
    ------
    Case or None
        None where no pose was found.
    """
    rng = np.random.default_rng(seed)
    for one in ROUNDS:
        changed, asked = one.change(landmark_map, queries, one.level, rng)
        options = RelocalizerOptions(matching=one.matching)
        relocalizer = Relocalizer(changed, replace(options, k=min(options.k, len(changed))))
        for query, place in zip(asked, places, strict=True):
            found = relocalizer.relocalize([query.observation])
            yield judge(found, query.map_from_camera, place, one) if found.solved else None


def fit(cases: Sequence[Case]) -> Calibration:
    """Return the coefficients of maximum likelihood.

    Parameters
    ----------
    cases : sequence of Case

    Raises
    ------
    OptionsError
        All poses are right, or all are wrong.
    """
    first = np.array([case.right[0] for case in cases], dtype=bool)
    if first.all() or not first.any():
        raise OptionsError(f'{first.sum()} of {len(first)} poses are right; a fit needs right and '
                           'wrong ones')
    support, given, right, handicaps = _padded(cases)
    scale = np.append(support[given].std(axis=0) + 1e-9, 1.0)
    weights = np.array([case.round.weight for case in cases])
    weights /= weights.sum()
    solved = minimize(_loss, np.append(0.0 * scale[:-1], 1.0),
                      (support / scale[:-1], given, right, handicaps, weights),
                      jac=True, method='L-BFGS-B', bounds=_BOUNDS)
    raw = Calibration(*map(float, [*solved.x / scale, 0.0, 0.0]))
    likely = np.clip(confidence(cases, raw), 1e-12, 1.0 - 1e-12)
    log_odds = np.log(likely / (1.0 - likely))

    def surprise(slope: float, knee: float) -> float:
        sharper = log_odds + slope * np.maximum(0.0, log_odds - knee)
        return float(weights @ np.log1p(np.exp(np.where(first, -sharper, sharper))))

    solutions = [minimize_scalar(surprise, bounds=(0.0, _MOST_SLOPE), args=(knee,),
                                 method='bounded') for knee in _KNEES]
    best = int(np.argmin([one.fun for one in solutions]))
    return raw._replace(knee=_KNEES[best], slope=float(solutions[best].x))


def _padded(cases: Sequence[Case]) -> tuple[NDArray[np.float64], NDArray[np.bool_],
                                             NDArray[np.bool_], NDArray[np.float64]]:
    """Return supports (n, h, 6), which exist (n, h), which are right (n, h), and handicaps."""
    support = np.zeros((len(cases), MAX_DISTINCT, len(_FIELDS)))
    given = np.zeros((len(cases), MAX_DISTINCT), dtype=bool)
    right, handicaps = np.zeros_like(given), np.zeros(given.shape)
    for row, case in enumerate(cases):
        count = len(case.supports)
        support[row, :count] = [[getattr(one, name) for name in _FIELDS]
                                for one in case.supports]
        given[row, :count], right[row, :count] = True, case.right
        handicaps[row, :count] = case.handicaps
    return support, given, right, handicaps


def _loss(coefficients: NDArray[np.float64], support: NDArray[np.float64],
          given: NDArray[np.bool_], right: NDArray[np.bool_],
          handicaps: NDArray[np.float64], weights: NDArray[np.float64]
          ) -> tuple[float, NDArray[np.float64]]:
    """Return the negative log likelihood and its derivatives (7,) by the coefficients."""
    utility = np.where(given, support @ coefficients[:-1] - handicaps, -1e9)
    utility = np.column_stack([utility, np.full(len(utility), coefficients[-1])])
    odds = np.exp(utility - utility.max(axis=1, keepdims=True))
    truth = np.column_stack([right, ~right.any(axis=1)])
    share = odds / odds.sum(axis=1, keepdims=True)
    true_share = odds * truth + 1e-300
    likely = true_share.sum(axis=1) / odds.sum(axis=1)
    pull = (share - true_share / true_share.sum(axis=1, keepdims=True)) * weights[:, None]
    gradient = np.append(np.einsum('nh,nhk->k', pull[:, :-1] * given, support),
                         pull[:, -1].sum())
    shrink = _RIDGE * np.append(coefficients[:-1], 0.0)
    return float(-weights @ np.log(likely) + shrink @ coefficients / 2), gradient + shrink


def confidence(cases: Iterable[Case], calibration: Calibration = DEFAULT) -> NDArray[np.float64]:
    """Return the confidence (n,) in the best pose of each case."""
    return np.array([confidences(case.supports, case.poses, calibration, case.handicaps)[0]
                     for case in cases])


def halves(cases: Sequence[Case], seed: int = 0) -> tuple[set[str], set[str]]:
    """Return two random halves of the places."""
    places = sorted({case.place for case in cases})
    order = np.random.default_rng(seed).permutation(len(places))
    return ({places[row] for row in order[::2]}, {places[row] for row in order[1::2]})


def cross_fitted(cases: Sequence[Case], seed: int = 0, elsewhere: bool = False
                 ) -> list[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Return confidence and correctness of each half's frames, fitted on the other half.

    Parameters
    ----------
    cases : sequence of Case
    seed : int
        Seed of the halves.
    elsewhere : bool
        Test on the rounds in maps of another place; else on the unchanged frames.
    """
    judged = []
    for own in halves(cases, seed):
        calibration = fit([case for case in cases if case.place not in own])
        asked = [case for case in cases if case.place in own
                 and (case.round.is_elsewhere if elsewhere else case.round.is_whole)]
        judged.append((confidence(asked, calibration) * [case.near for case in asked],
                       np.array([case.right[0] for case in asked], dtype=bool)))
    return judged


def _read(options: argparse.Namespace) -> list[Case]:
    """Return the cases of all query files."""
    if len(options.queries) != len(options.map):
        raise OptionsError('give as many maps as query files, in the same order')
    cases: list[Case | None] = []
    for number, (path, map_path) in enumerate(zip(options.queries, options.map, strict=True)):
        landmark_map = LandmarkMap.from_file(map_path)
        recorded = load_queries(path, landmark_map.landmark_ids)
        queries = make_queries(recorded, landmark_map, every_frame=True)
        cases += tqdm(collect(landmark_map, queries,
                              [f'{number}.{frame.group}' for frame in recorded], options.seed),
                      path.name, len(queries) * len(ROUNDS), disable=None)
    return [case for case in cases if case is not None]


def _report(name: str, likely: NDArray[np.float64], right: NDArray[np.bool_]) -> str:
    lines = [f'{name}: {len(right)} poses, {right.sum()} of them within {RIGHT_M:g} m']
    for least in (0.9, 0.95, 0.98, 0.99, 0.995):
        accepted = likely >= least
        false, count = int((accepted & ~right).sum()), int(accepted.sum())
        low, high = wilson_interval(count - false, count) if count else (0.0, 1.0)
        lines.append(f'  min_confidence {least:5}: {count:4} accepted, {false} of them wrong, '
                     f'precision {low:.3f} to {high:.3f} (95 %), '
                     f'recall {(accepted & right).sum() / max(int(right.sum()), 1):.3f}')
    return '\n'.join(lines)


def _draw(folder: Path, judged: dict[str, tuple[NDArray[np.float64], NDArray[np.bool_]]]) -> None:
    # late, since the fit needs no matplotlib
    from cliploc_ros.evaluation.figures import add_legend, new_axes, save_figure
    from cliploc_ros.evaluation.output import make_folder
    from cliploc_ros.evaluation.trust import draw_reliability

    make_folder(folder)
    figure, axes = new_axes('confidence', f'share of poses within {RIGHT_M:g} m')
    draw_reliability(axes, judged)
    axes.set_title('each half, fitted on the other half', fontsize=9)
    add_legend(figure)
    print(f'wrote {save_figure(figure, folder / "reliability.png")}')


def run(arguments: list[str]) -> int:
    """Fit, test and print."""
    parser = argparse.ArgumentParser(prog='calibration', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, nargs='+', metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, nargs='+', metavar='YAML',
                        help='of each query file')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw a reliability diagram there')
    options = parser.parse_args(arguments)
    cases = _read(options)
    judged = cross_fitted(cases, options.seed)
    for number, half in enumerate(judged, start=1):
        print(_report(f'half {number}, fitted on the other half', *half))
    print(_report('both', np.concatenate([half[0] for half in judged]),
                  np.concatenate([half[1] for half in judged])))
    elsewhere = cross_fitted(cases, options.seed, elsewhere=True)
    print(_report('another place, both', np.concatenate([half[0] for half in elsewhere]),
                  np.concatenate([half[1] for half in elsewhere])))
    if options.out is not None:
        _draw(options.out, {f'half {number}': half for number, half in enumerate(judged, start=1)})
    print('\nfitted on all frames, for cliploc_ros/core/acceptance/confidence.py:\n'
          + ', '.join(f'{name}={value:.3g}' for name, value in fit(cases)._asdict().items()))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
