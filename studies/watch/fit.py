# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit the evidence of one look to looks at correct and wrong poses in simulated worlds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.geometry.transforms import Tolerance
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.watch.look import LookEvidence, align, look_at, measure
from studies.reports import fit_logistic, table
from studies.watch.judge import displaced, drifting, kidnapped, simulated_drive, turned_camera

_IMAGES = 60
# Shares of objects that changed since the place was mapped; worlds take these in turn.
_CHANGED = (0.0, 0.0, 0.2, 0.4)
# A quarter of the cameras is turned, by up to this angle [deg].
_TURNED_SHARE, _TURNED_DEG = 0.25, (2.0, 10.0)
_WRONG_M, _WRONG_DEG = ((1.3, 3.0), (3.0, 6.0)), ((25.0, 60.0), (60.0, 180.0))
_NOT_NEAR = Tolerance(1.2, 25.0)
_RIDGE = 1e-5


class Look(NamedTuple):
    """The evidence of a look at a correct or a wrong pose."""

    kind: str
    evidence: LookEvidence
    is_right: bool


def looks_of(kind: str, seed: int) -> list[Look]:
    """Return the looks of a drive through a world, each at the correct and at a wrong pose."""
    drive = simulated_drive(kind, seed, _IMAGES, _CHANGED[seed % len(_CHANGED)])
    rng, options = np.random.default_rng([seed, 5]), RelocalizerOptions(matching='class')
    turn = turned_camera(rng.uniform(*_TURNED_DEG) if rng.random() < _TURNED_SHARE else 0.0, rng)
    poses, found = drifting(drive.poses, rng), []
    drive.landmark_map.prepare()
    for observation, right in zip(drive.observations, poses, strict=True):
        joined = look_at(drive.landmark_map, observation, options)
        wrong = _wrong(right, poses, drive.bounds, rng)
        found += [Look(kind, measure(align(joined, pose @ turn))[0], is_right)
                  for pose, is_right in ((right, True), (wrong, False))]
    return found


def _wrong(right: NDArray[np.float64], poses: NDArray[np.float64], bounds: NDArray[np.float64],
           rng: np.random.Generator) -> NDArray[np.float64]:
    """Make a correct pose (4, 4) wrong: moved, turned, or anywhere on the drive."""
    kind = rng.integers(5)
    if kind < 2:
        return kidnapped(right, rng.uniform(*_WRONG_M[kind]), 0.0, bounds, rng) @ right
    if kind < 4:
        return kidnapped(right, 0.0, rng.uniform(*_WRONG_DEG[kind - 2]), bounds, rng) @ right
    while True:
        x, y = rng.normal(size=2)
        other = displaced(poses[rng.integers(len(poses))], x, y, rng.uniform(-np.pi, np.pi))
        if not _NOT_NEAR.agree(other, right):
            return other


def fit(looks: Sequence[Look]) -> Calibration:
    """Return the maximum-likelihood coefficients."""
    seen = [look for look in looks if look.evidence.known]
    terms = np.array([[*look.evidence.terms.values()] for look in seen])
    found = fit_logistic(terms, np.array([look.is_right for look in seen]),
                         np.full(terms.shape[1], 2.0 * _RIDGE * len(seen)))
    return CALIBRATION._replace(watch=CALIBRATION.watch._replace(
        **dict(zip(seen[0].evidence.terms, map(float, found), strict=True))))


def report(looks: Sequence[Look], calibration: Calibration) -> str:
    """Return a table of how well single looks at three or more objects detect wrong poses."""
    rows = []
    for kind in (*dict.fromkeys(look.kind for look in looks), 'all'):
        known = [look for look in looks if kind in (look.kind, 'all') and look.evidence.known >= 3]
        odds = np.array([look.evidence.log_odds(True, calibration) for look in known])
        right = np.array([look.is_right for look in known])
        rows.append([kind, len(known), f'{odds[right].mean():.1f}', f'{odds[~right].mean():.1f}',
                     f'{(odds[right] < 0.0).mean():.2f}', f'{(odds[~right] > 0.0).mean():.2f}',
                     f'{np.logaddexp(0.0, np.where(right, -odds, odds)).mean():.2f}'])
    return table(['place', 'looks', 'mean log odds, right', 'wrong', 'right ones against',
                  'wrong ones for', 'log loss'], rows)
