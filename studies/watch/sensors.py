# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The angle of a camera that is turned on its robot."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform
from studies.reports import table
from studies.watch.judge import watch_of
from studies.watch.localizers import drifting, simulated_drive, turned_camera

_TURNS_DEG = (0.0, 2.0, 3.0, 5.0, 7.0, 10.0)
# Looks that match three objects after which a turn is judged.
_LOOKS, _IMAGES, _LEAST_MATCHED = 20, 200, 3


def mount_table(kinds: Sequence[str], seeds: Sequence[int]) -> str:
    """Return a table of how well the turn of a camera is known after some looks."""
    rows = []
    for degrees in _TURNS_DEG:
        found = [one for kind in kinds for seed in seeds
                 if (one := _turn_after_looks(kind, seed, degrees)) is not None]
        named = np.array([one[1:] for one in found if one[0]]).reshape(-1, 3)
        errors, level, sigmas = named.T if len(named) else np.zeros((3, 1))
        rows.append([f'{degrees:g}', len(found), len(named), f'{np.median(errors):.2f}',
                     f'{np.quantile(errors, 0.9):.2f}', f'{(errors < 0.5).mean():.2f}',
                     f'{(level < 0.5).mean():.2f}', f'{np.median(sigmas):.2f}',
                     f'{(errors < 2.5 * sigmas).mean():.2f}'])
    return table(['camera turned by [deg]', 'drives', 'named', 'error, median [deg]', '90 %',
                  'within .5 deg', 'roll and pitch within .5 deg', 'stated deviation, median',
                  'error within 2.5 deviations'], rows)


def _turn_after_looks(kind: str, seed: int, degrees: float
                      ) -> tuple[bool, float, float, float] | None:
    """Return whether a turn is named after _LOOKS looks, its errors and deviation [deg].

    The second error is that without the part about the vertical. None: the drive has fewer looks
    at three objects.
    """
    drive, rng = simulated_drive(kind, seed, _IMAGES), np.random.default_rng([seed, 13])
    watch, turn = watch_of(drive), turned_camera(degrees, rng)
    poses = drifting(drive.poses, rng, 0.1)
    count = 0
    for observation, pose in zip(drive.observations, poses, strict=True):
        # the stated mount puts the camera where it would be without the turn
        given = pose @ invert_transform(turn)
        report = watch.look(observation, given)
        count += report.matched >= _LEAST_MATCHED
        if count < _LOOKS:
            continue
        if report.camera_turn is None:
            return False, 0.0, 0.0, 0.0
        error = Rotation.from_matrix(turn[:3, :3].T @ report.camera_turn.stated_from_true[
            :3, :3]).as_rotvec(degrees=True)
        up = drive.poses[0][2, :3]
        level = error - up * (up @ error)
        return (True, float(np.linalg.norm(error)), float(np.linalg.norm(level)),
                report.camera_turn.sigma_deg)
    return None
