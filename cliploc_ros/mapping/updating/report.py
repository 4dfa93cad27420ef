# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an update says about its result: each landmark, what became of it, and the evidence."""

from dataclasses import asdict, dataclass
from typing import Any

from cliploc_ros.mapping.report import LeftOut

_ROWS_SHOWN = 40


@dataclass(frozen=True)
class UpdatedLandmark:
    """What became of one landmark.

    Parameters
    ----------
    landmark_id, label, class_id : str
    center : tuple of float
        Where it is now; where it was if it is missing [m].
    distance_m : float
        By how much its centre changed [m].
    evidence : str
        Why.
    last_seen : float, optional
        [s]; None where unknown.
    rivals : tuple of str
        Landmarks that this object could be as well.
    """

    landmark_id: str
    label: str
    class_id: str
    center: tuple[float, float, float]
    distance_m: float
    evidence: str
    last_seen: float | None = None
    rivals: tuple[str, ...] = ()

    def line(self) -> str:
        """Return it as one line of text."""
        x, y, z = self.center
        text = f"{self.landmark_id} '{self.label}' at {x:.2f} {y:.2f} {z:.2f}: {self.evidence}"
        return text + (f'; or it is {", ".join(self.rivals)}: they look alike'
                       if self.rivals else '')


@dataclass(frozen=True)
class UpdateReport:
    """The result of an update in numbers and words.

    Parameters
    ----------
    frames, viewpoints : int
        Of the recording.
    offset_m, offset_deg : float
        How far the recording's coordinate frame was off; it is corrected.
    pose_change_m, pose_change_deg : float
        Root mean square by which the poses changed besides.
    confirmed, moved, missing, new, not_observed : tuple of UpdatedLandmark
    left_out : tuple of LeftOut
        New objects that are not good enough for the map.
    notes : tuple of str
    """

    frames: int
    viewpoints: int
    offset_m: float
    offset_deg: float
    pose_change_m: float
    pose_change_deg: float
    confirmed: tuple[UpdatedLandmark, ...]
    moved: tuple[UpdatedLandmark, ...]
    missing: tuple[UpdatedLandmark, ...]
    new: tuple[UpdatedLandmark, ...]
    not_observed: tuple[UpdatedLandmark, ...]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the report as text."""
        rows = [f'{len(self.confirmed)} confirmed, {len(self.moved)} moved, '
                f'{len(self.missing)} missing, {len(self.new)} new, '
                f'{len(self.not_observed)} not observed; {self.frames} frames of '
                f'{self.viewpoints} viewpoints']
        rows += [f'note: {note}' for note in self.notes]
        for name, found in (('moved', self.moved), ('missing', self.missing), ('new', self.new)):
            rows += [f'{name}: {one.line()}' for one in found[:_ROWS_SHOWN]]
            if len(found) > _ROWS_SHOWN:
                rows.append(f'{name}: and {len(found) - _ROWS_SHOWN} more, see --report')
        return rows
