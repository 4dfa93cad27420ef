# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the watch on drives with a correct localizer, a wrong one, and a turned camera.

Localizers are simulated: correct up to drift, displaced, or with a wrong mount of the camera.
"""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
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
from studies.reports import table
from studies.worlds.world import make_drive

#: Time between looks [s].
LOOK_S = 2.0
# Drift of a localizer: range of the error in x and y [m], deviation of the yaw [deg], and number
# of looks in which its sensors reduce an error to 1 / e.
_DRIFT_M, _DRIFT_DEG, _DRIFT_LOOKS = (0.05, 0.3), 1.0, 5.0
# Deviations of a step of odometry.
_STEP_M, _STEP_DEG = 0.01, 0.3
#: Displacements of a localizer against odometry [m], [deg].
DISPLACED = ((1.0, 0.0), (2.0, 0.0), (5.0, 0.0), (0.0, 30.0), (0.0, 90.0), (0.0, 180.0))
KIDNAPPED, TWIN = 'kidnapped', 'at a twin'
# Number of looks at three or more objects within which a wrong pose should be detected, and
# greatest number of all looks.
LOOKS, _OBJECTS, _MOST_LOOKS = 5, 3, 30
# Looks of a drive at which poses become wrong: the first, their number, their least distance, and
# the number of kidnaps at each.
_FIRST_LOOK, _PARTS, _LEAST_PART, _KIDNAPS = 10, 6, 12, 3
_FAR = Tolerance(2.0, 30.0)
# Gap between the rooms of studies.worlds.places.two_rooms [m].
_GAP_M = 1.5
# A landmark counts if at least this many looks should show it.
_EXPECTED = 5
_TURNS_DEG = (0.0, 2.0, 3.0, 5.0, 7.0, 10.0)
# Images of a drive with a turned camera, and number of looks that match three objects before the
# turn is judged.
_IMAGES, _TURN_LOOKS = 200, 20


class Drive(NamedTuple):
    """The observations and poses of a camera on a drive."""

    name: str
    landmark_map: LandmarkMap
    observations: Sequence[Observation]  #: With odometry
    poses: NDArray[np.float64]  #: (k, 4, 4): true map_from_camera
    #: (L,): see studies.worlds.world.Drive
    changed: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    #: (2, 2): least and greatest x and y of a localizer's poses [m]
    bounds: NDArray[np.float64]


def simulated_drive(kind: str, seed: int, images: int, changed: float = 0.0,
                    labels: bool = False) -> Drive:
    """Return a drive through a world; without labels, objects are matched by class."""
    found = make_drive(kind, seed, images, changed)
    poses = np.array([query.map_from_camera for query in found.world.queries])
    seen = [query.observation if labels else replace(query.observation, similarities=None)
            for query in found.world.queries]
    stamped = [replace(observation, stamp_ns=round(row * LOOK_S * NS_PER_S))
               for row, observation in enumerate(seen)]
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
    """Return the poses (k, 4, 4) of a localizer with drift that its sensors correct."""
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
    """Return wrong_from_right (4, 4), which displaces a pose (4, 4) within the bounds."""
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
    """Return a turn (4, 4) about a random axis: stated_from_true of a displaced camera."""
    axis = rng.normal(size=3)
    return make_transform(Rotation.from_rotvec(
        np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix(), np.zeros(3))


def recorded_drive(name: str, recorded: PosedDetections, landmark_map: LandmarkMap,
                   rows: Sequence[int]) -> Drive:
    """Return frames of a recording, in the order of time, as a drive without similarities."""
    poses = recorded.map_from_camera[np.array(rows)]
    seen = [observation_of(recorded, row, round(recorded.stamps_s[row] * NS_PER_S))
            for row in rows]
    none = np.zeros(len(landmark_map), dtype=np.bool_)
    return Drive(name, landmark_map, with_odometry(seen, poses, rows[0]), poses, none, none,
                 np.array([poses[:, :2, 3].min(axis=0), poses[:, :2, 3].max(axis=0)]))


class Alarm(NamedTuple):
    """The result of the watch for one wrong pose."""

    place: str
    case: str
    lost: bool  #: Whether it was lost within LOOKS looks at three or more objects
    noticed: bool  #: Whether the state after these looks was not localized
    is_mapped: bool  #: Whether two or more of these looks should have shown two landmarks


class Right(NamedTuple):
    """The result of the watch on a drive with a correct localizer."""

    place: str
    states: tuple[WatchState, ...]
    named: int  #: Number of landmarks named as missing at the end
    rightly: int  #: Number of these that are wrong in the map
    wrong: int  #: Number of wrong landmarks among those that _EXPECTED looks should show


def watch_of(drive: Drive) -> Watch:
    """Return a new watch with the map of a drive."""
    return Watch(Relocalizer(drive.landmark_map, RelocalizerOptions(
        matching='class' if drive.observations[0].similarities is None else 'hybrid',
        k=min(RelocalizerOptions.k, len(drive.landmark_map)))))


def judge(drive: Drive, seed: int, wrong_poses: bool) -> tuple[Right, list[Alarm]]:
    """Run the watch with a correct localizer, and with localizers that become wrong."""
    rng, watch = np.random.default_rng([seed, 9]), watch_of(drive)
    begins = range(_FIRST_LOOK, len(drive.poses), max(_LEAST_PART, len(drive.poses) // _PARTS))
    poses, alarms, reports = drifting(drive.poses, rng), list[Alarm](), list[WatchReport]()
    for row, (observation, pose) in enumerate(zip(drive.observations, poses, strict=True)):
        if wrong_poses and row in begins:
            for case, seen, wrong in _wrong_ways(drive, poses, row, rng):
                wrong_watch = copy.deepcopy(watch, {id(drive.landmark_map): drive.landmark_map})
                found = _alarm(wrong_watch, drive, case, seen, wrong)
                alarms += [found] if found is not None else []
        reports.append(watch.look(observation, pose))
    ids = drive.landmark_map.landmark_ids
    is_wrong = drive.changed | drive.wrong
    expected = np.zeros(len(ids), dtype=np.int64)
    for observation, pose in zip(drive.observations, drive.poses, strict=True):
        expected[expect(drive.landmark_map, observation.camera, pose,
                        np.empty(0, dtype=np.int64)).landmarks] += 1
    named = [ids.index(landmark_id) for landmark_id in reports[-1].missing]
    return Right(drive.name, tuple(report.state for report in reports), len(named),
                 int(is_wrong[named].sum()),
                 int((is_wrong & (expected >= _EXPECTED)).sum())), alarms


def _wrong_ways(drive: Drive, poses: NDArray[np.float64], row: int, rng: np.random.Generator
                ) -> Iterator[tuple[str, Sequence[Observation], NDArray[np.float64]]]:
    """Yield each case with the observations and the wrong poses of a localizer from a look on."""
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
        # odometry and localizer continue as if the robot had not been kidnapped
        ahead = slice(there, there + _MOST_LOOKS)
        back = odom[row - 1] @ invert_transform(odom[there])
        later_ns = drive.observations[row].stamp_ns - drive.observations[there].stamp_ns
        yield KIDNAPPED, [replace(
            seen, stamp_ns=seen.stamp_ns + later_ns, odom_from_camera=back @ odom_from_camera)
            for seen, odom_from_camera in zip(drive.observations[ahead], odom[ahead], strict=True)
            ], poses[row - 1] @ invert_transform(poses[there]) @ poses[ahead]


def _twin_of(drive: Drive, pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the transform (4, 4) to the place that looks alike; None if there is none."""
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
    """Run a watch on wrong poses; None if there are too few looks at objects."""
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
    """Return a table of drives with a correct localizer, by place."""
    rows = []
    for place in (*dict.fromkeys(drive.place for drive in found), 'all'):
        drives = [drive for drive in found if place in (drive.place, 'all')]
        states = [state for drive in drives for state in drive.states]
        alarms = sum(now == WatchState.LOST != before for drive in drives for before, now in zip(
            drive.states, drive.states[1:], strict=False))
        hours = len(states) * LOOK_S / 3600.0
        named, rightly, wrong = (sum(values) for values in zip(*(drive[2:] for drive in drives),
                                                               strict=True))
        rows.append([place, f'{hours:.1f}', alarms, f'{alarms / hours:.2f}',
                     f'{chi2.ppf(0.95, 2 * alarms + 2) / 2.0 / hours:.2f}',
                     *(f'{states.count(state) / len(states):.2f}' for state in WatchState),
                     f'{rightly} of {named}', f'{rightly} of {wrong}'])
    return table(['right poses', 'hours', 'false alarms', 'an hour', 'below (95 %)', *WatchState,
                  'named rightly', f'of those wrong and expected {_EXPECTED} times'], rows)


def alarm_table(found: Sequence[Alarm]) -> str:
    """Return a table of the shares of wrong poses that the watch reports as lost."""
    cases = [*dict.fromkeys(alarm.case for alarm in found)]
    rows = []
    for place in (*dict.fromkeys(alarm.place for alarm in found), 'all'):
        alarms = [alarm for alarm in found if place in (alarm.place, 'all')]
        rows.append([place, *(_share([alarm for alarm in alarms if alarm.case == case])
                              for case in cases),
                     _share([alarm for alarm in alarms
                             if alarm.case == KIDNAPPED and alarm.is_mapped])])
    return table([f'lost within {LOOKS} looks; not localized; cases', *cases,
                  f'{KIDNAPPED} to where the map shows something'], rows)


def _share(alarms: Sequence[Alarm]) -> str:
    if not alarms:
        return ''
    return (f'{np.mean([alarm.lost for alarm in alarms]):.2f}; '
            f'{np.mean([alarm.noticed for alarm in alarms]):.2f}; {len(alarms)}')


def mount_table(kinds: Sequence[str], seeds: Sequence[int]) -> str:
    """Return a table of the errors of a camera's estimated turn after some looks."""
    rows = []
    for degrees in _TURNS_DEG:
        found = [turn for kind in kinds for seed in seeds
                 if (turn := _turn_after_looks(kind, seed, degrees)) is not None]
        named = np.array([turn[1:] for turn in found if turn[0]]).reshape(-1, 3)
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
    """Return whether the watch reports a turn after _TURN_LOOKS looks, its errors and deviation.

    All are in degrees. The second error excludes the rotation about the vertical. None: the drive
    has fewer looks at three objects.
    """
    drive, rng = simulated_drive(kind, seed, _IMAGES), np.random.default_rng([seed, 13])
    watch, turn = watch_of(drive), turned_camera(degrees, rng)
    poses = drifting(drive.poses, rng, 0.1)
    count = 0
    for observation, pose in zip(drive.observations, poses, strict=True):
        # the localizer's pose is that of a camera without the turn, as its mount states
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
