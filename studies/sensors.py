# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure errors of real wheel odometry, IMUs and accelerometers: ``python -m studies.sensors``.

Wheels are compared with the gyroscope, the orientation of an IMU with its acceleration over
seconds, and an accelerometer with motion capture. The verticals are those of the relocalizer's
``gravity: imu``.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from cliploc_ros.command import run_command
from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.offline.datasets.parsing import parse_stamp_ns
from cliploc_ros.offline.datasets.tum import read_image_list, read_tum_trajectory
from cliploc_ros.offline.mapping.options import OdometryErrors
from cliploc_ros.ros.inputs.odometry import OdometryWindow
from cliploc_ros.ros.inputs.robot_state import (
    WINDOW_NS,
    NoVerticalError,
    Sample,
    mean_up,
    sample_from_msg,
)
from cliploc_ros.units import NS_PER_S
from studies.reports import table

_WAYS_M = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_LOST, _RATES_HZ = (0.0, 0.1), (5.0, 10.0, 25.0, 50.0)
_LAGS_S = np.arange(-0.5, 0.51, 0.02)
# A slower robot counts as standing. The mean acceleration within this time before and after is
# taken as gravity.
_STANDS_M_S, _SLOW_NS = 0.01, 3 * NS_PER_S // 2
# Time between two instants of a vertical, and number of samples that the node keeps.
_EVERY_S, _KEPT = 0.2, 1000
# Rotation from the accelerometer of TUM's freiburg1 to the optical coordinate frame.
_STATED_MOUNT = Rotation.from_matrix(np.diag([-1.0, -1.0, 1.0]))


@dataclass(frozen=True)
class Robot:
    """A recording of a robot: n poses, m messages of an IMU."""

    name: str
    poses: NDArray[np.float64]  #: (n, 8): stamp [s], position [m], quaternion x, y, z, w
    samples: tuple[Sample, ...]  #: (m,)
    turn_rates: NDArray[np.float64]  #: (m, 3): angular rates of the gyroscope [rad/s]

    @property
    def yaws(self) -> NDArray[np.float64]:
        """Return the unwrapped yaw (n,) of the poses [rad]."""
        return np.unwrap(Rotation.from_quat(self.poses[:, 4:]).as_euler('ZYX')[:, 0])

    @property
    def ways(self) -> NDArray[np.float64]:
        """Return the distance (n,) driven up to each pose [m]."""
        return _summed(np.linalg.norm(np.diff(self.poses[:, 1:4], axis=0), axis=1))

    @property
    def speeds(self) -> NDArray[np.float64]:
        """Return the speed (n,) at each pose [m/s]."""
        return np.gradient(self.ways, self.poses[:, 0])


def read_robot(bag: Path) -> Robot:
    """Read a bag of ROS 1 or 2 with one odometry topic and one IMU topic."""
    poses, samples, rates = [], list[Sample](), []
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for topic, _, data in reader.messages():
            msg: Any = reader.deserialize(data, topic.msgtype)
            at_s = msg.header.stamp.sec + msg.header.stamp.nanosec / NS_PER_S
            if topic.msgtype.endswith('/Odometry'):
                p, q = msg.pose.pose.position, msg.pose.pose.orientation
                poses.append((at_s, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            elif topic.msgtype.endswith('/Imu') and (sample := sample_from_msg(msg)) is not None:
                w = msg.angular_velocity
                samples.append(sample)
                rates.append((w.x, w.y, w.z))
    return Robot(bag.stem, np.array(poses), tuple(samples), np.array(rates))


def restarts_table(robot: Robot, rates_hz: Sequence[float], tries: int = 4) -> str:
    """Return the table of false restarts in a drive without restarts, with messages left out.

    A row uses each n-th message for a rate. Its cells sum several tries for a share of lost
    messages.
    """
    rng, rows = np.random.default_rng(0), []
    for rate_hz in rates_hz:
        every = max(1, round(1.0 / np.median(np.diff(robot.poses[:, 0])) / rate_hz))
        found = []
        for lost in _LOST:
            runs = 0
            for first in range(tries):
                window = OdometryWindow(30.0)
                for row in range(first % every, len(robot.poses), every):
                    if rng.random() >= lost:
                        at_s, *pose = robot.poses[row]
                        window.add(round(at_s * NS_PER_S), np.array(pose[:3]), np.array(pose[3:]))
                runs += window.run
            found.append(runs)
        rows.append([robot.name, f'{rate_hz:g}', tries * len(robot.poses) // every, *found])
    return table(['bag', 'rate [Hz]', 'messages',
                  *(f'restarts, {lost:.0%} lost' for lost in _LOST)], rows)


def angle_table(robot: Robot) -> str:
    """Return the table that compares the angle of the wheels with that of the gyroscope."""
    lag_s, gyro = _gyro_yaw(robot)
    wheels, ways, errors = robot.yaws, robot.ways, OdometryErrors()
    turned = _summed(np.abs(np.diff(wheels)))
    rows = []
    for way in _WAYS_M:
        first = np.searchsorted(ways, np.arange(0.0, ways[-1] - way, max(way / 2, _WAYS_M[0])))
        last = np.minimum(np.searchsorted(ways, ways[first] + way), len(ways) - 1)
        off = np.degrees((wheels[last] - wheels[first]) - (gyro[last] - gyro[first]))
        straight = np.abs(turned[last] - turned[first]) < 0.1 * max(way, 0.5)
        of_map = np.degrees(errors.sigmas(ways[last] - ways[first],
                                          turned[last] - turned[first])[:, 1])
        of_looks = np.degrees([odometry_deviations(_step(robot, *ends))[5]
                               for ends in zip(first, last, strict=True)])
        rows.append([f'{way:g}', len(off), *(f'{value:.2f}' for value in (
            _rms(off), _rms(off[straight]), np.quantile(np.abs(off), 0.95), _rms(off / of_map),
            _rms(off / of_looks)))])
    turns = np.diff(gyro[::10]), np.diff(wheels[::10])
    scale = float(turns[0] @ turns[1] / (turns[0] @ turns[0]))
    return f'{robot.name}: wheels turn {scale:.2f} of the gyroscope, {lag_s:+.2f} s apart\n\n' \
        + table(['way [m]', 'pieces', 'error of the angle, rms [deg]', 'straight on', '95 %',
                 "rms in deviations of `build_map`'s odometry", 'of the looks'], rows)


def vertical_rows(robot: Robot) -> list[list[Any]]:
    """Return rows for the vertical of an IMU: from orientation, and from acceleration alone."""
    stamps = np.array([sample.stamp_ns for sample in robot.samples])
    instants_s = np.arange(robot.poses[0, 0] + 2.0, robot.poses[-1, 0] - 2.0, _EVERY_S)
    off_slow, off_alone = [], []
    for at_ns in np.round(instants_s * NS_PER_S).astype(np.int64):
        (first, begin), (last, end) = (np.searchsorted(stamps, [at_ns + side * _SLOW_NS,
                                                                at_ns + side * WINDOW_NS])
                                       for side in (-1, 1))
        near = robot.samples[begin:end]
        up = _up(near, robot.samples[max(0, end - _KEPT):end])
        slow = np.mean([sample.acceleration for sample in robot.samples[first:last]
                        if sample.acceleration is not None], axis=0)
        off_slow.append(_angle_deg(up, slow))
        off_alone.append(_angle_deg(up, _up([sample._replace(up=None) for sample in near])))
    stands = np.interp(instants_s, robot.poses[:, 0], robot.speeds) < _STANDS_M_S
    return [_vertical_row(f'{robot.name}, {what}, {state}', np.array(off)[chosen])
            for what, off in (('orientation, against acceleration over 3 s', off_slow),
                              ('acceleration alone, against orientation', off_alone))
            for state, chosen in (('stands', stands), ('drives', ~stands))]


def accelerometer_rows(folder: Path) -> list[list[Any]]:
    """Return rows for the vertical of a TUM folder's accelerometer against motion capture."""
    lines = (folder / 'accelerometer.txt').read_text(encoding='utf-8').splitlines()
    fields = [line.split() for line in lines if not line.startswith('#')]
    samples = [Sample(parse_stamp_ns(stamp, str(folder)), None, np.array(xyz, dtype=np.float64))
               for stamp, *xyz in fields]
    stamps = np.array([sample.stamp_ns for sample in samples])
    truth, found = [], []
    poses = read_tum_trajectory(folder / 'groundtruth.txt')
    for at_ns in read_image_list(folder / 'rgb.txt')[0]:
        pose = poses.pose_at(at_ns)
        rows = np.nonzero(np.abs(stamps - at_ns) <= WINDOW_NS)[0]
        if pose is not None and len(rows):
            truth.append(pose[2, :3])
            found.append(_up([samples[row] for row in rows]))
    ups, known = np.array(found), np.isfinite(found).all(axis=1)
    fitted = Rotation.align_vectors(np.array(truth)[known], ups[known])[0]
    mount_deg = np.degrees((fitted * _STATED_MOUNT.inv()).magnitude())
    return [_vertical_row(f'{folder.name}, acceleration, {name}', np.array(
        [_angle_deg(up, mount.apply(found_up)) for up, found_up in zip(truth, ups, strict=True)]))
        for name, mount in (('stated mount', _STATED_MOUNT),
                            (f'fitted mount ({mount_deg:.1f} degrees off)', fitted))]


def _vertical_row(name: str, off_deg: NDArray[np.float64]) -> list[Any]:
    known = off_deg[np.isfinite(off_deg)]
    return [name, len(off_deg), f'{len(known) / len(off_deg):.2f}',
            *(f'{value:.1f}' for value in np.quantile(known, [0.5, 0.68, 0.95, 1.0]))]


def _up(near: Sequence[Sample], recent: Sequence[Sample] = ()) -> NDArray[np.float64]:
    """Return the vertical (3,) as the node computes it; NaN if it cannot."""
    try:
        return mean_up(near, recent, 'imu')
    except NoVerticalError:
        return np.full(3, np.nan)


def _gyro_yaw(robot: Robot) -> tuple[float, NDArray[np.float64]]:
    """Return the lag of the IMU's stamps [s], and the yaw (n,) by gyroscope at the poses [rad].

    The lag fits the yaw of the wheels best. The mean rate of the standing robot is subtracted.
    """
    at_s = np.array([sample.stamp_ns for sample in robot.samples]) / NS_PER_S
    ups = np.array([np.full(3, np.nan) if sample.up is None else sample.up
                    for sample in robot.samples])
    rates = (robot.turn_rates * ups).sum(axis=1)
    stands = np.interp(at_s, robot.poses[:, 0], robot.speeds) < _STANDS_M_S
    rates -= rates[stands].mean() if stands.any() else 0.0
    yaws = _summed((rates[1:] + rates[:-1]) / 2 * np.diff(at_s))
    fits = [(float(np.std(np.diff(robot.yaws - shifted, 1))), float(lag), shifted)
            for lag in _LAGS_S for shifted in [np.interp(robot.poses[:, 0] + lag, at_s, yaws)]]
    _, lag_s, best = min(fits, key=lambda fit: fit[0])
    return lag_s, best


def _step(robot: Robot, first: int, last: int) -> NDArray[np.float64]:
    """Return the robot's motion (4, 4) between two poses, by odometry."""
    first_pose, last_pose = (make_transform(Rotation.from_quat(robot.poses[row, 4:]).as_matrix(),
                                 robot.poses[row, 1:4]) for row in (first, last))
    return np.asarray(np.linalg.inv(first_pose) @ last_pose)


def _summed(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values ** 2))) if len(values) else np.nan


def _angle_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def run(arguments: Sequence[str]) -> int:
    """Print the tables, as Markdown."""
    parser = argparse.ArgumentParser(prog='python -m studies.sensors', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--bags', type=Path, nargs='*', default=[], metavar='BAG',
                        help='bags with odometry and an IMU with orientation')
    parser.add_argument('--tum', type=Path, nargs='*', default=[], metavar='DIR',
                        help='TUM folders with accelerometer.txt')
    options = parser.parse_args(arguments)
    robots = [read_robot(bag) for bag in options.bags]
    for robot in robots:
        most_hz = 1.1 / np.median(np.diff(robot.poses[:, 0]))
        print(restarts_table(robot, [rate for rate in _RATES_HZ if rate <= most_hz]), '\n')
        print(angle_table(robot), '\n')
    rows = [row for robot in robots for row in vertical_rows(robot)]
    rows += [row for folder in options.tum for row in accelerometer_rows(folder)]
    print(table(['vertical', 'instants', 'with a vertical', 'error, median [deg]', '68 %', '95 %',
                 'greatest'], rows))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
