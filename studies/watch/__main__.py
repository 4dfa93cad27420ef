# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how well the watch detects a wrong localizer: ``python -m studies.watch``.

A simulated localizer drifts, or is displaced, or its robot is kidnapped. ``judge`` uses simulated
worlds, ``recorded`` uses recorded boxes, and ``mount`` uses a camera that is turned on its robot.
``localizer`` judges the recorded poses of a real localizer. ``fit`` fits the evidence of looks.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from tqdm import tqdm

from cliploc_ros.command import not_negative, positive_int, run_command
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.watch import Watch
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.datasets.tum import read_tum_trajectory
from cliploc_ros.offline.mapping.building import build_map
from studies.acceptance.fit import FITTED_KINDS
from studies.reports import print_section
from studies.watch import fit, judge
from studies.watch.recordings import watch_recording, write_watch
from studies.worlds.places import KINDS

# Frames of a recording at 30 Hz between two looks.
_STEP = 60


def _fit(options: argparse.Namespace) -> None:
    looks = [look for seed in tqdm(range(options.first_seed, options.first_seed + options.worlds),
                                   disable=None)
             for kind in KINDS for look in fit.looks_of(kind, seed)]
    fitted = fit.fit([look for look in looks if look.kind in FITTED_KINDS])
    print(fit.report(looks, fitted))
    print('\nfor calibration.yaml, watch:\n' + ', '.join(
        f'{name}: {value:.3g}' for name, value in fitted.watch.items()
        if value != CALIBRATION.watch[name]))


def _judge(options: argparse.Namespace) -> None:
    for changed in options.changed:
        drives = (judge.simulated_drive(kind, seed, options.images, changed, options.labels)
                  for kind in options.kinds
                  for seed in range(options.first_seed, options.first_seed + options.worlds))
        _print(drives, options.worlds * len(options.kinds), changed == 0.0,
               f'{changed:.0%} of the objects moved or gone')


def _recorded(options: argparse.Namespace) -> None:
    recorded = load_observations(options.observations)
    its_map = LandmarkMap.from_file(options.map)
    # the map was built from the even frames
    _print((judge.recorded_drive('fr3', recorded, its_map, range(first, len(recorded), _STEP))
            for first in range(1, _STEP, options.every)), len(range(1, _STEP, options.every)),
           True, str(options.map))
    if options.splits is not None:
        drives = []
        for name, rows in json.loads(options.splits.read_text()).items():
            built = build_map(recorded.select_frames(rows['map'])).landmark_map
            drives.append(judge.recorded_drive(name, recorded, built, sorted(
                frame for _, is_main, frame in rows['queries'] if is_main)))
        _print(drives, len(drives), True, 'maps of the splits')


def _localizer(options: argparse.Namespace) -> None:
    truth = None if options.truth is None else read_tum_trajectory(options.truth)
    relocalizer = Relocalizer(LandmarkMap.from_file(options.map), RelocalizerOptions(
        matching='class', tilt_deviation_deg=options.tilt_deviation))
    looks = watch_recording(load_observations(options.observations), Watch(relocalizer), truth,
                            options.period)
    print(write_watch(options.out, looks))


def _print(drives: Iterable[judge.Drive], count: int, wrong_poses: bool, title: str) -> None:
    right, alarms = list[judge.Right](), list[judge.Alarm]()
    for number, drive in enumerate(tqdm(drives, title, count, disable=None)):
        of_drive, alarms_of_drive = judge.judge(drive, number, wrong_poses)
        right.append(of_drive)
        alarms += alarms_of_drive
    print_section(f'{title}: right poses', judge.right_table(right))
    if alarms:
        print_section(f'{title}: wrong poses', judge.alarm_table(alarms))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a study; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m studies.watch', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)

    def add(name: str, command: object, summary: str) -> argparse.ArgumentParser:
        own = commands.add_parser(name, help=summary, description=summary)
        own.set_defaults(command=command)
        return own

    def add_worlds(own: argparse.ArgumentParser, worlds: int, first_seed: int) -> None:
        own.add_argument('--worlds', type=positive_int, default=worlds, metavar='N',
                         help='worlds of each kind (%(default)s)')
        own.add_argument('--first-seed', type=int, default=first_seed, help='(%(default)s)')
        own.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS), metavar='KIND')

    add_worlds(add('fit', _fit, 'the fit of the evidence to simulated worlds'), 16, 0)
    judged = add('judge', _judge, 'alarms in simulated worlds')
    add_worlds(judged, 9, 1000)
    judged.add_argument('--images', type=positive_int, default=300, help='(%(default)s)')
    judged.add_argument('--changed', type=float, nargs='+', default=[0.0, 0.2, 0.4],
                        help='shares of the objects that moved or are gone (0 0.2 0.4)')
    judged.add_argument('--labels', action='store_true',
                        help='match by labels, with weak and strong encoders')
    recorded = add('recorded', _recorded, 'alarms with recorded boxes')
    recorded.add_argument('--observations', type=Path, required=True, metavar='NPZ')
    recorded.add_argument('--map', type=Path, required=True, metavar='YAML')
    recorded.add_argument('--splits', type=Path, metavar='JSON', help='rows to map and to query')
    recorded.add_argument('--every', type=positive_int, default=4, metavar='N',
                          help='start a drive at every N-th frame (%(default)s)')
    own = add('localizer', _localizer, 'alarms at the recorded poses of a localizer')
    own.add_argument('--observations', type=Path, required=True, metavar='NPZ',
                     help='file of build_map --record-to, with localizer poses and odometry')
    own.add_argument('--map', type=Path, required=True, metavar='YAML')
    own.add_argument('--truth', type=Path, metavar='TUM', help='true poses of the camera')
    own.add_argument('--period', type=not_negative, default=2.0, metavar='SECONDS',
                     help='least time between two looks (%(default)s)')
    own.add_argument('--tilt-deviation', type=float, default=40.0, metavar='DEG',
                     help="deviation of the camera's tilt (%(default)s)")
    own.add_argument('--out', type=Path, default=Path('watched'), metavar='DIR')
    mount = add('mount', lambda options: print(judge.mount_table(
        options.kinds, range(options.first_seed, options.first_seed + options.worlds))),
        'the angle of a camera that is turned on its robot')
    add_worlds(mount, 10, 1000)
    options = parser.parse_args(arguments)
    options.command(options)
    return 0


if __name__ == '__main__':
    sys.exit(run_command(run))
