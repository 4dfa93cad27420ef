# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the watch says on drives: of a right localizer, a wrong one, and of a turned camera.

Localizers are simulated: right with drift, displaced, or of a camera mounted wrong.
"""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.geometry.transforms import Tolerance, invert_transform, make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.visibility import expect
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.watch import Watch, WatchReport, WatchState
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S
from studies.acceptance.places import observation_of
from studies.reports import grouped, short, table
from studies.worlds.world import make_drive

#: Time between looks [s].
LOOK_S = 2.0
# A localizer drifts, and its sensors correct it: deviations on x and y [m], and of the yaw [deg];
# errors fall to 1 / e in this many looks. Odometry: of a step [m] [deg].
_DRIFT_M, _DRIFT_DEG, _DRIFT_LOOKS = (0.05, 0.3), 1.0, 5.0
_STEP_M, _STEP_DEG = 0.01, 0.3
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


class Drive(NamedTuple):
    """What a camera saw on a drive, and where it was."""

    name: str
    landmark_map: LandmarkMap
    observations: Sequence[Observation]  #: With odometry
    poses: NDArray[np.float64]  #: (k, 4, 4): true map_from_camera
    #: (L,): see studies.worlds.world.Drive
    changed: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    #: (2, 2): least and greatest x and y where a localizer may put the robot [m]
    bounds: NDArray[np.float64]


def simulated_drive(kind: str, seed: int, images: int, changed: float = 0.0,
                    labels: bool = False) -> Drive:
    """Return a drive through a world; without labels, objects are matched by class."""
    found = make_drive(kind, seed, images, changed)
    poses = np.array([query.map_from_camera for query in found.world.queries])
    seen = [query.observation if labels else replace(query.observation, similarities=None)
            for query in found.world.queries]
    stamped = [replace(one, stamp_ns=round(row * LOOK_S * NS_PER_S))
               for row, one in enumerate(seen)]
    return Drive(kind, found.world.landmark_map, with_odometry(stamped, poses, seed), poses,
                 found.changed, found.wrong, np.array([(0.0, 0.0), found.size]))


def with_odometry(observations: Sequence[Observation], poses: NDArray[np.float64], seed: int
                  ) -> list[Observation]:
    """Return observations with odometry along true poses (k, 4, 4), with errors of each step."""
    rng = np.random.default_rng([seed, 11])
    odom, way_m, found = poses[0], 0.0, []
    for row, observation in enumerate(observations):
        if row:
            step = invert_transform(poses[row - 1]) @ poses[row]
            length = float(np.linalg.norm(step[:3, 3]))
            moved = length > 1e-3 or np.trace(step[:3, :3]) < 3.0 - 1e-5
            error = make_transform(
                Rotation.from_rotvec(np.radians(_STEP_DEG) * rng.normal(size=3)).as_matrix(),
                _STEP_M * rng.normal(size=3)) if moved else np.eye(4)
            odom, way_m = odom @ step @ error, way_m + length
        found.append(replace(observation, odom_from_camera=odom, odom_way_m=way_m))
    return found


def drifting(poses: NDArray[np.float64], rng: np.random.Generator, drift_m: float | None = None
             ) -> NDArray[np.float64]:
    """Return the poses (k, 4, 4) of a localizer whose errors come and go."""
    count, keep = len(poses), np.exp(-1.0 / _DRIFT_LOOKS)
    noise = rng.normal(size=(count, 3))
    for row in range(1, count):
        noise[row] = keep * noise[row - 1] + np.sqrt(1.0 - keep ** 2) * noise[row]
    # the mean length of a vector of two normal values is 1.25 deviations
    noise[:, :2] *= (rng.uniform(*_DRIFT_M) if drift_m is None else drift_m) / 1.25
    lengths = np.linalg.norm(noise[:, :2], axis=1, keepdims=True)
    noise[:, :2] *= np.minimum(1.0, _DRIFT_M[1] / np.maximum(lengths, 1e-9))
    noise[:, 2] *= np.radians(_DRIFT_DEG)
    return np.array([displaced(pose, x, y, yaw)
                     for pose, (x, y, yaw) in zip(poses, noise.tolist(), strict=True)])


def displaced(pose: NDArray[np.float64], x: float, y: float, yaw: float
              ) -> NDArray[np.float64]:
    """Return a pose (4, 4) moved in the plane [m] and turned about its vertical [rad]."""
    turn = Rotation.from_euler('z', yaw).as_matrix()
    return make_transform(turn @ pose[:3, :3], pose[:3, 3] + (x, y, 0.0))


def kidnapped(pose: NDArray[np.float64], metres: float, degrees: float,
              bounds: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return wrong_from_right (4, 4), which displaces a localizer at a pose (4, 4) in a place."""
    x, y = 0.0, 0.0
    if metres:
        angles = rng.uniform(-np.pi, np.pi, 50)
        steps = metres * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ends = pose[:2, 3] + steps
        outside = np.maximum(bounds[0] - ends, ends - bounds[1]).clip(0.0).sum(axis=1)
        x, y = steps[int(np.argmin(outside))]
    wrong = displaced(pose, x, y, np.radians(degrees) * rng.choice((-1.0, 1.0)))
    return wrong @ invert_transform(pose)


def turned_camera(degrees: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a turn (4, 4) about a random axis: stated_from_true of a camera that was hit."""
    axis = rng.normal(size=3)
    return make_transform(Rotation.from_rotvec(
        np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix(), np.zeros(3))


def recorded_drive(name: str, recorded: PosedDetections, landmark_map: LandmarkMap,
                   rows: Sequence[int]) -> Drive:
    """Return some frames of a recording, in the order of time, as a drive, by class."""
    poses = recorded.map_from_camera[np.array(rows)]
    seen = [observation_of(recorded, row, round(recorded.stamps_s[row] * NS_PER_S))
            for row in rows]
    none = np.zeros(len(landmark_map), dtype=np.bool_)
    return Drive(name, landmark_map, with_odometry(seen, poses, rows[0]), poses, none, none,
                 np.array([poses[:, :2, 3].min(axis=0), poses[:, :2, 3].max(axis=0)]))


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
    return Right(drive.name, tuple(report.state for report in reports), len(named),
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
    odom = np.array([observation.odom_from_camera for observation in drive.observations])
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


def glance_table(right: Sequence[Right], alarms: Sequence[Alarm]) -> str:
    """Return a short table of all drives together."""
    states = [state for drive in right for state in drive.states]
    false = sum(now == WatchState.LOST != before for drive in right
                for before, now in pairwise(drive.states))
    by_case = grouped(alarms, ['case']).items()
    return table(['localizer', f'`lost` within {LOOKS} looks', 'no longer `localized`'], [
        ['right', f'{false} times in {len(states) * LOOK_S / 3600.0:.1f} h', ''],
        *([case, short(float(np.mean([alarm.lost for alarm in own]))),
           short(float(np.mean([alarm.noticed for alarm in own])))] for (case,), own in by_case)])


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
