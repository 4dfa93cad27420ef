# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose between the answers: ``python -m studies.tracks --help``.

One localizer gets all images of a drive with the poses of a simulated odometry. The table compares
the single accepted answers, the last accepted answer carried by odometry (publish_tf without a
track), the track, and a filter that fuses odometry and the accepted answers with their covariances
for filters (the equations of robot_localization, in six dimensions). All but the single answers
count at each image after the first accepted answer. NEES is divided by its six degrees of freedom.

Drives are through simulated worlds; with --folders, also through recordings of real rooms by
keyframes: every other image is mapped. Odometry errs by a share of each step and turn, at random
and, half as much, all along. EVENTS: ``carried``: the robot is carried to another place in the
middle, which odometry does not see. ``slips``: its wheels slip, odometry then reports three times
the way for ten images. ``stands``: it does not move.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.command import positive, positive_int, run_command
from cliploc_ros.core.fit.covariance import moved_pose, normalized_square, odometry_deviations
from cliploc_ros.core.geometry.transforms import RIGHT_M, invert_transform, pose_difference
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.units import NS_PER_S
from studies.reports import grouped, print_section, run_all, table
from studies.rooms.rooms import frames_of_raws, open_folder, posed
from studies.worlds.world import make_drive

_PERIOD_S, _SLIPS, _WORLDS = 0.5, 10, ('room', 'office', 'shop')
EVENTS = 'none', 'carried', 'slips', 'stands'
_FREEDOMS = 6
Pose = NDArray[np.float64]


class Task(NamedTuple):
    """A drive."""

    place: str  #: A kind of worlds, or a folder
    seed: int
    images: int
    odometry: float  #: Its error, as a share of steps and turns
    event: str


@dataclass(frozen=True)
class Step:
    """All poses at one image; errors are NaN before the first accepted answer."""

    task: Task
    number: int
    accepted: bool
    in_doubt: bool
    #: Errors [m] of the answer, the answer carried by odometry, the track, and the filter
    single_m: float = np.nan
    held_m: float = np.nan
    track_m: float = np.nan
    filter_m: float = np.nan
    track_nees: float = np.nan
    filter_nees: float = np.nan
    held: Pose | None = None
    track: Pose | None = None

    @property
    def kind(self) -> tuple[str, float, str]:
        """Return the event, the error of odometry, and what gives the poses."""
        return (self.task.event, self.task.odometry,
                'objects' if self.task.place in _WORLDS else 'keyframes')


class Filter:
    """A Kalman filter of the pose, which takes answers as independent."""

    def __init__(self, odom: Pose, pose: Pose, covariance: Pose) -> None:
        self.odom, self.pose, self.covariance = odom, pose, covariance

    def carry(self, odom: Pose) -> None:
        """Predict with a pose of odometry."""
        motion = invert_transform(self.odom) @ odom
        pose, turns = self.pose @ motion, np.eye(6)
        x, y, z = pose[:3, 3] - self.pose[:3, 3]
        turns[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        self.covariance = turns @ self.covariance @ turns.T + np.diag(
            odometry_deviations(motion) ** 2)
        self.odom, self.pose = odom, pose

    def correct(self, pose: Pose, covariance: Pose) -> None:
        """Fuse a pose."""
        gain = np.linalg.solve(self.covariance + covariance, self.covariance).T
        self.pose = moved_pose(self.pose, gain @ pose_difference(self.pose, pose))
        rest = np.eye(6) - gain
        self.covariance = rest @ self.covariance @ rest.T + gain @ covariance @ gain.T


def odometry_of(poses: Sequence[Pose], task: Task) -> list[Pose]:
    """Return the poses by odometry, which begins at the origin; it errs in way and heading."""
    rng = np.random.default_rng([task.seed, round(1000 * task.odometry)])
    always, found = rng.normal(0.0, task.odometry / 2.0, 2), [np.eye(4)]
    for number, (before, after) in enumerate(pairwise(poses)):
        motion = np.linalg.inv(before) @ after
        if task.event == 'carried' and number == len(poses) // 2 - 1:
            motion = np.eye(4)
        way = float(np.linalg.norm(motion[:3, 3]))
        turn = float(Rotation.from_matrix(motion[:3, :3]).magnitude())
        motion[:3, 3] *= 1.0 + always[0] + rng.normal(0.0, task.odometry)
        if task.event == 'slips' and 0 <= number - len(poses) // 2 < _SLIPS:
            motion[:3, 3] *= 3.0
        wrong = (always[1] * turn + task.odometry * rng.normal() * turn
                 + np.radians(5.0 * task.odometry) * way * rng.normal())
        motion[:3, :3] = Rotation.from_rotvec(wrong * before[2, :3]).as_matrix() @ motion[:3, :3]
        found.append(found[-1] @ motion)
    return found


def _world(task: Task) -> tuple[Relocalizer, KeyframeLocalizer | None, list[PosedQuery]]:
    drive = make_drive(task.place, task.seed, 2 * task.images, stands=task.event == 'stands')
    queries = list(drive.world.queries)
    if task.event == 'carried':  # from the first quarter of the drive to the last one
        queries = queries[:task.images // 2] + queries[-(task.images // 2):]
    landmark_map = drive.world.landmark_map
    return Relocalizer(landmark_map, RelocalizerOptions(k=min(3, len(landmark_map)))), None, \
        queries[:task.images]


def _room(task: Task) -> tuple[Relocalizer, KeyframeLocalizer | None, list[PosedQuery]]:
    folder, frames, _ = open_folder(task.place)
    raws, empty = posed(frames), LandmarkMap.empty('map')
    mapped, asked = raws[task.seed % 2::2], raws[1 - task.seed % 2::2]
    layer = build_layer(frames_of_raws(folder, mapped), empty, LayerOptions(0.0, 0.0))
    nothing = Detections(np.empty((0, 4)), (), np.empty(0))
    queries = []
    for number, raw in enumerate(asked):
        image, camera = raw.color()
        truth = np.array(raw.map_from_camera)
        # the poses of 7-Scenes are rotations to four digits only
        truth[:3, :3] = Rotation.from_matrix(truth[:3, :3]).as_matrix()
        frame = Observation(camera, nothing, np.empty((0, 0), np.float32))
        queries.append(PosedQuery(number, frame, truth, image=partial(np.asarray, image)))
    return Relocalizer(empty, RelocalizerOptions(matching='class')), KeyframeLocalizer(layer), \
        queries


def drive(task: Task) -> list[Step]:
    """Return all steps of a drive."""
    relocalizer, keyframes, queries = (_world if task.place in _WORLDS else _room)(task)
    localizer, steps = Localizer(relocalizer, keyframes), []
    odom = odometry_of([query.map_from_camera for query in queries], task)
    fused: Filter | None = None
    held: tuple[Pose, Pose] | None = None
    way_m = 0.0
    for number, (query, pose) in enumerate(zip(queries, odom, strict=True)):
        if number:
            way_m += float(np.linalg.norm(pose[:3, 3] - odom[number - 1][:3, 3]))
        frame = replace(query.observation, odom_from_camera=pose, odom_way_m=way_m,
                        stamp_ns=round((1.0 + _PERIOD_S * number) * NS_PER_S))
        images = () if query.image is None else (query.image(),)
        found = localizer.answer(Query((frame,), images, 0, 5, 5.0, is_thorough=False))
        given, truth = localizer.follow(found), query.map_from_camera
        track = localizer.track and localizer.track.carried(pose)
        if fused is not None:
            fused.carry(pose)
        if found.accepted and found.map_from_camera is not None and given is not None:
            held = found.map_from_camera, pose
            if fused is None:
                fused = Filter(pose, found.map_from_camera, given)
            else:
                fused.correct(found.map_from_camera, given)
        step = Step(task, number, found.accepted, bool(track and track.contradicting))
        if track is not None and fused is not None and held is not None:
            carried = held[0] @ invert_transform(held[1]) @ pose
            errors = [float(np.linalg.norm(each[:3, 3] - truth[:3, 3]))
                      for each in (carried, track.map_from_camera, fused.pose)]
            step = replace(
                step, held=carried, track=track.map_from_camera, held_m=errors[0],
                single_m=errors[0] if found.accepted else np.nan, track_m=errors[1],
                filter_m=errors[2], track_nees=normalized_square(
                    track.map_from_camera, track.covariance, truth) / _FREEDOMS,
                filter_nees=normalized_square(fused.pose, fused.covariance, truth) / _FREEDOMS)
        steps.append(step)
    return steps


def _cell(errors: Sequence[float]) -> str:
    values = np.array(errors)[~np.isnan(errors)]
    return f'{np.median(values):.3f}, {np.quantile(values, 0.95):.3f}' if len(values) else ''


def _mean(squares: Sequence[float]) -> str:
    values = np.array(squares)[~np.isnan(squares)]
    return f'{np.median(values):.2f}, {values.mean():.2f}' if len(values) else ''


def _jumps(steps: Sequence[Step], what: str) -> str:
    """Return the 95th percentile of the changes of a standing robot's pose [cm], [deg]."""
    poses = [pose for step in steps[len(steps) // 10:]
             if (pose := getattr(step, what)) is not None]
    changes = np.abs([pose_difference(*both) for both in pairwise(poses)] or np.empty((0, 6)))
    return '' if not len(changes) else (
        f'{100.0 * np.quantile(np.linalg.norm(changes[:, :3], axis=1), 0.95):.2f}, '
        f'{np.degrees(np.quantile(np.linalg.norm(changes[:, 3:], axis=1), 0.95)):.2f}')


def _carried_row(steps: Sequence[Step]) -> list[object]:
    """Return the looks of one drive after the carry until doubt and until the pose is right."""
    after = steps[len(steps) // 2:]
    noticed = next((number for number, step in enumerate(after) if step.in_doubt
                    or step.track_m < RIGHT_M), None)
    right = next((number for number, step in enumerate(after)
                  if step.track_m < RIGHT_M and not step.in_doubt), None)
    silent = sum(step.track_m > RIGHT_M and not step.in_doubt for step in after[noticed or 0:])
    accepted = [number for number, step in enumerate(after) if step.accepted]
    return [steps[0].task.place, steps[0].task.seed, f'{len(accepted)} of {len(after)}',
            accepted[0] if accepted else '', noticed, right, silent,
            sum(step.held_m > RIGHT_M for step in after[noticed or 0:])]


def run(arguments: Sequence[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--kinds', nargs='*', choices=_WORLDS, default=_WORLDS,
                        help='kinds of worlds (all)')
    parser.add_argument('--folders', nargs='*', default=(), metavar='DIR[@METRES]',
                        help='recordings of real rooms (none)')
    parser.add_argument('--drives', type=positive_int, default=3, metavar='N',
                        help='drives of a kind, or both halves of a recording (%(default)s)')
    parser.add_argument('--images', type=positive_int, default=240, metavar='N',
                        help='images of a simulated drive (%(default)s)')
    parser.add_argument('--odometry', nargs='+', type=positive, default=(0.01, 0.03, 0.1),
                        metavar='SHARE', help='errors of odometry (.01 .03 .1)')
    parser.add_argument('--events', nargs='+', choices=EVENTS, default=('none',))
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args(arguments)
    tasks = [Task(place, seed, options.images, error, event)
             for event in options.events for error in options.odometry
             for place in (*options.kinds, *options.folders)
             for seed in range(options.drives if place in _WORLDS else min(2, options.drives))
             if place in _WORLDS or event == 'none']
    steps: list[Step] = run_all(partial(lambda: drive), tasks, 'drives', options.workers)
    rows = []
    for (kind,), own in grouped(steps, ['kind']).items():
        rows.append([*kind, len(own), sum(step.accepted for step in own), *(
            _cell([getattr(step, name) for step in own])
            for name in ('single_m', 'held_m', 'track_m', 'filter_m')), *(
            _mean([getattr(step, name) for step in own])
            for name in ('track_nees', 'filter_nees')), sum(step.in_doubt for step in own)])
    print_section('A pose between the answers', table(
        ['event', 'odometry', 'by', 'images', 'accepted', 'single: median, 95 % [m]',
         'held: median, 95 % [m]', 'track: median, 95 % [m]', 'filter: median, 95 % [m]',
         'track NEES / 6: median, mean', 'filter NEES / 6: median, mean', 'in doubt'], rows))
    by_task = {task: own for (task,), own in grouped(steps, ['task']).items()}
    if 'carried' in options.events:
        print_section('Carried', table(
            ['place', 'seed', 'accepted afterwards', 'looks until the first', 'until doubt',
             'until right', 'track wrong without doubt after that', 'held wrong after that'],
            [_carried_row(own) for task, own in by_task.items() if task.event == 'carried']))
    if 'stands' in options.events:
        print_section('Standing', table(
            ['place', 'seed', 'accepted', 'held: 95 % of changes [cm], [deg]', 'track'],
            [[task.place, task.seed, sum(step.accepted for step in own), _jumps(own, 'held'),
              _jumps(own, 'track')] for task, own in by_task.items() if task.event == 'stands']))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
