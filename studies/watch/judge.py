# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the watch says on drives: of a right localizer, a wrong one, and of a turned camera."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.geometry.transforms import Tolerance, invert_transform, make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.expectation import expect
from cliploc_ros.core.watch.watch import Watch, WatchReport, WatchState
from studies.reports import table
from studies.watch.localizers import (
    LOOK_S,
    Drive,
    drifting,
    kidnapped,
    simulated_drive,
    turned_camera,
)

#: Displacements [m] [deg] against odometry.
DISPLACED = ((1.0, 0.0), (2.0, 0.0), (5.0, 0.0), (0.0, 30.0), (0.0, 90.0), (0.0, 180.0))
KIDNAPPED, TWIN = 'kidnapped', 'at a twin'
# Looks at three objects or more within which a wrong pose should be noticed, and the most looks.
# Poses become wrong at some looks of a drive.
LOOKS, _OBJECTS, _MOST_LOOKS = 5, 3, 30
_FIRST_LOOK, _PARTS, _LEAST_PART, _KIDNAPS = 10, 6, 12, 3
_FAR = Tolerance(2.0, 30.0)
# Gap between the rooms of studies.worlds.places.two_rooms [m].
_GAP_M = 1.5
# A landmark counts where this many looks should show it.
_EXPECTED = 5
_TURNS_DEG = (0.0, 2.0, 3.0, 5.0, 7.0, 10.0)
# Images of a drive with a turned camera, and looks that match three objects after which the turn
# is judged.
_IMAGES, _TURN_LOOKS = 200, 20


class Alarm(NamedTuple):
    """What the watch said about one wrong pose."""

    place: str
    case: str
    lost: bool  #: Within LOOKS looks at three objects or more
    noticed: bool  #: No longer localized then
    is_mapped: bool  #: Two of these looks or more should have shown two landmarks


class Right(NamedTuple):
    """What it said on a drive with a right localizer."""

    place: str
    states: tuple[WatchState, ...]
    named: int  #: Landmarks named as missing at the end, and those of them that are wrong
    rightly: int
    wrong: int  #: Landmarks that are wrong, of those that _EXPECTED looks should show


def watch_of(drive: Drive) -> Watch:
    """Return a watch in the map of a drive."""
    return Watch(Relocalizer(drive.landmark_map, RelocalizerOptions(
        matching='class' if drive.observations[0].similarities is None else 'hybrid',
        k=min(RelocalizerOptions.k, len(drive.landmark_map)))))


def judge(drive: Drive, seed: int, wrong_poses: bool) -> tuple[Right, list[Alarm]]:
    """Return what the watch says of a right localizer, and of wrong ones from some looks on."""
    rng, watch = np.random.default_rng([seed, 9]), watch_of(drive)
    begins = range(_FIRST_LOOK, len(drive.poses), max(_LEAST_PART, len(drive.poses) // _PARTS))
    poses, alarms, reports = drifting(drive.poses, rng), list[Alarm](), list[WatchReport]()
    for row, (observation, pose) in enumerate(zip(drive.observations, poses, strict=True)):
        if wrong_poses and row in begins:
            for case, seen, wrong in _wrong_ways(drive, poses, row, rng):
                its = copy.deepcopy(watch, {id(drive.landmark_map): drive.landmark_map})
                found = _alarm(its, drive, case, seen, wrong)
                alarms += [found] if found is not None else []
        reports.append(watch.look(observation, pose))
    ids = drive.landmark_map.landmark_ids
    is_wrong = drive.changed | drive.wrong
    expected = np.zeros(len(ids), dtype=np.int64)
    for observation, pose in zip(drive.observations, drive.poses, strict=True):
        expected[expect(drive.landmark_map, observation.camera, pose,
                        np.empty(0, dtype=np.int64)).landmarks] += 1
    named = [ids.index(one) for one in reports[-1].missing]
    return Right(drive.name, tuple(one.state for one in reports), len(named),
                 int(is_wrong[named].sum()),
                 int((is_wrong & (expected >= _EXPECTED)).sum())), alarms


def _wrong_ways(drive: Drive, poses: NDArray[np.float64], row: int, rng: np.random.Generator
                ) -> Iterator[tuple[str, Sequence[Observation], NDArray[np.float64]]]:
    """Return the case, what the camera sees and the wrong poses of a localizer from a look on."""
    ahead = slice(row, row + _MOST_LOOKS)
    for metres, degrees in DISPLACED:
        wrong = kidnapped(poses[row], metres, degrees, drive.bounds, rng)
        yield (f'{metres:g} m' if metres else f'{degrees:g} deg', drive.observations[ahead],
               wrong @ poses[ahead])
    twin = _twin_of(drive, poses[row])
    if twin is not None:
        yield TWIN, drive.observations[ahead], twin @ poses[ahead]
    others = np.nonzero(~_FAR.agreeing(poses[row][None], poses[:-LOOKS])[0])[0]
    odom = np.array([one.odom_from_camera for one in drive.observations])
    for there in rng.choice(others, min(_KIDNAPS, len(others)), replace=False):
        # neither odometry nor the localizer notice that the robot is carried away
        ahead = slice(there, there + _MOST_LOOKS)
        back = odom[row - 1] @ invert_transform(odom[there])
        later_ns = drive.observations[row].stamp_ns - drive.observations[there].stamp_ns
        yield KIDNAPPED, [replace(
            one, stamp_ns=one.stamp_ns + later_ns, odom_from_camera=back @ its_odom)
            for one, its_odom in zip(drive.observations[ahead], odom[ahead], strict=True)
            ], poses[row - 1] @ invert_transform(poses[there]) @ poses[ahead]


def _twin_of(drive: Drive, pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the move (4, 4) to the place that looks alike; None where there is none."""
    _, (width, depth) = drive.bounds
    if drive.name == 'two rooms':
        shift = 0.5 * (width + _GAP_M)
        return make_transform(np.eye(3), np.array(
            [shift if pose[0, 3] < 0.5 * width else -shift, 0.0, 0.0]))
    if drive.name == 'hall':
        return make_transform(np.diag([-1.0, -1.0, 1.0]), np.array([width, depth, 0.0]))
    return None


def _alarm(watch: Watch, drive: Drive, case: str, seen: Sequence[Observation],
           poses: NDArray[np.float64]) -> Alarm | None:
    """Return what a watch says of wrong poses; None if there are too few looks at objects."""
    index, looks, lost, mapped = drive.landmark_map.classes, 0, False, 0
    for observation, pose in zip(seen, poses, strict=True):
        report = watch.look(observation, pose)
        lost |= report.state == WatchState.LOST
        own = index.are_own(index.classes_of(observation.detections.class_ids))
        if own.sum() >= _OBJECTS:
            looks, mapped = looks + 1, mapped + (report.expected >= 2)
        if looks == LOOKS:
            return Alarm(drive.name, case, lost, report.state != WatchState.LOCALIZED,
                         mapped >= 2)
    return None


def right_table(found: Sequence[Right]) -> str:
    """Return a table of drives with a right localizer, by place."""
    rows = []
    for place in (*dict.fromkeys(one.place for one in found), 'all'):
        its = [one for one in found if place in (one.place, 'all')]
        states = [state for one in its for state in one.states]
        alarms = sum(now == WatchState.LOST != before for one in its for before, now in zip(
            one.states, one.states[1:], strict=False))
        hours = len(states) * LOOK_S / 3600.0
        named, rightly, wrong = (sum(values) for values in zip(*(one[2:] for one in its),
                                                               strict=True))
        rows.append([place, f'{hours:.1f}', alarms, f'{alarms / hours:.2f}',
                     f'{chi2.ppf(0.95, 2 * alarms + 2) / 2.0 / hours:.2f}',
                     *(f'{states.count(one) / len(states):.2f}' for one in WatchState),
                     f'{rightly} of {named}', f'{rightly} of {wrong}'])
    return table(['right poses', 'hours', 'false alarms', 'an hour', 'below (95 %)', *WatchState,
                  'named rightly', f'of those wrong and expected {_EXPECTED} times'], rows)


def alarm_table(found: Sequence[Alarm]) -> str:
    """Return a table of the shares of wrong poses that are called lost, by place and case."""
    cases = [*dict.fromkeys(one.case for one in found)]
    rows = []
    for place in (*dict.fromkeys(one.place for one in found), 'all'):
        its = [one for one in found if place in (one.place, 'all')]
        rows.append([place, *(_share([one for one in its if one.case == case])
                              for case in cases),
                     _share([one for one in its if one.case == KIDNAPPED and one.is_mapped])])
    return table([f'lost within {LOOKS} looks; not localized; cases', *cases,
                  f'{KIDNAPPED} to where the map shows something'], rows)


def _share(some: Sequence[Alarm]) -> str:
    if not some:
        return ''
    return (f'{np.mean([one.lost for one in some]):.2f}; '
            f'{np.mean([one.noticed for one in some]):.2f}; {len(some)}')


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
    """Return whether a turn is named after _TURN_LOOKS looks, its errors and deviation [deg].

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
        count += report.matched >= _OBJECTS
        if count < _TURN_LOOKS:
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
