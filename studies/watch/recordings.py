# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the watch on a recording of a localizer's poses.

The observation file holds the localizer's poses; a trajectory gives the true ones.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cliploc_ros.core.geometry.transforms import SAME_ANSWER, pose_error
from cliploc_ros.core.watch.watch import Watch, WatchState
from cliploc_ros.files.storage import make_folder, write_text
from cliploc_ros.offline.datasets.poses import Poses
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S
from studies.acceptance.places import observation_of


@dataclass(frozen=True)
class WatchedLook:
    """The report of the watch after one look, and the localizer's true errors."""

    stamp_s: float
    state: str
    probability: float
    reason: str
    matched: int
    expected: int
    missing: tuple[str, ...]
    fault: str
    way_m: float  #: Path length of the localizer's pose since the first look
    #: Errors of the localizer's pose; None if the truth is unknown
    error_m: float | None
    error_deg: float | None

    @property
    def is_right(self) -> bool | None:
        """Return whether the localizer's pose is correct; None if the truth is unknown."""
        if self.error_m is None or self.error_deg is None:
            return None
        return self.error_m < SAME_ANSWER.distance_m and self.error_deg < SAME_ANSWER.angle_deg


def watch_recording(recorded: PosedDetections, watch: Watch, truth: Poses | None, period_s: float
                    ) -> list[WatchedLook]:
    """Run a watch on a recording, whose poses are those of a localizer.

    Parameters
    ----------
    truth : Poses, optional
        True poses of the camera.
    period_s : float
        Least time between two looks [s].
    """
    found, way_m = list[WatchedLook](), 0.0
    last_ns, last_pose = -NS_PER_S * 10**9, recorded.map_from_camera[:1]
    assert recorded.stamps_ns is not None
    for row, stamp_ns in enumerate(recorded.stamps_ns.tolist()):
        pose = recorded.map_from_camera[row]
        way_m += float(np.linalg.norm(pose[:3, 3] - last_pose[..., :3, 3]))
        last_pose = pose
        if stamp_ns - last_ns < period_s * NS_PER_S:
            continue
        last_ns = stamp_ns
        said = watch.look(observation_of(recorded, row, stamp_ns), pose)
        true = None if truth is None else truth.pose_at(stamp_ns)
        error_m, error_deg = (None, None) if true is None else pose_error(pose, true)
        found.append(WatchedLook(
            stamp_ns / NS_PER_S, str(said.state), said.probability, said.reason, said.matched,
            said.expected, said.missing, said.fault, way_m, error_m, error_deg))
    return found


def alarms_of(looks: Sequence[WatchedLook]) -> list[WatchedLook]:
    """Return the looks at which alarms start."""
    states = [WatchState.UNCERTAIN, *(look.state for look in looks)]
    return [look for look, (before, now) in zip(looks, pairwise(states), strict=True)
            if now == WatchState.LOST != before]


def times_to_alarm(looks: Sequence[WatchedLook]) -> list[dict[str, Any]]:
    """Return the start of each stretch of wrong poses, and the delay of the watch's alarm.

    The delays seconds, metres and looks are None if there was no alarm.
    """
    found: list[dict[str, Any]] = []
    begins = [row for row, look in enumerate(looks) if look.is_right is False
              and (row == 0 or looks[row - 1].is_right is not False)]
    for first in begins:
        last = next((row for row in range(first, len(looks))
                     if looks[row].is_right is not False), len(looks))
        noticed = next((row for row in range(first, last)
                        if looks[row].state == WatchState.LOST), None)
        began = looks[first]
        found.append({
            'stamp_s': began.stamp_s,
            'seconds': None if noticed is None else looks[noticed].stamp_s - began.stamp_s,
            'metres': None if noticed is None else looks[noticed].way_m - began.way_m,
            'looks': None if noticed is None else noticed - first + 1})
    return found


def summarize_watch(looks: Sequence[WatchedLook]) -> dict[str, Any]:
    """Return the statistics of a watched recording; None where the truth is unknown."""
    hours = (looks[-1].stamp_s - looks[0].stamp_s) / 3600.0 if len(looks) > 1 else 0.0
    alarms = alarms_of(looks)
    false = sum(alarm.is_right is True for alarm in alarms)
    knows = any(look.is_right is not None for look in looks)
    return {
        'looks': len(looks), 'hours': hours, 'way_m': looks[-1].way_m if looks else 0.0,
        'states': {str(state): sum(look.state == state for look in looks) for state in WatchState},
        'alarms': len(alarms), 'false_alarms': false if knows else None,
        'false_alarms_per_hour': false / hours if knows and hours else None,
        'wrong_stretches': times_to_alarm(looks)}


def write_watch(folder: Path, looks: Sequence[WatchedLook]) -> str:
    """Write watch.json; return a short summary."""
    summary = summarize_watch(looks)
    make_folder(folder)
    write_text(folder / 'watch.json', json.dumps(
        {**summary, 'every_look': [asdict(look) for look in looks]}, indent=1))
    states = ', '.join(f'{name} {count}' for name, count in summary['states'].items())
    lines = [f'{len(looks)} looks in {60.0 * summary["hours"]:.1f} min and '
             f'{summary["way_m"]:.0f} m: {states}; {summary["alarms"]} alarms']
    if summary['false_alarms'] is not None:
        rate = summary['false_alarms_per_hour']
        lines.append(f'false alarms: {summary["false_alarms"]}'
                     + ('' if rate is None else f', {rate:.2f} an hour'))
    for stretch in summary['wrong_stretches']:
        lines.append('wrong poses: never called lost' if stretch['looks'] is None else
                     f'wrong poses: called lost after {stretch["looks"]} looks, '
                     f'{stretch["seconds"]:.1f} s, {stretch["metres"]:.1f} m')
    return '\n'.join(lines)
