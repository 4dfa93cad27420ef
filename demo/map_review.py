# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the map that the demo built with the room: found, missed and false objects."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from cliploc_ros.core.geometry.ellipsoid import outline_points, shape_matrices
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.files.storage import write_file
from cliploc_ros.offline.datasets.parsing import parse_stamp_ns
from cliploc_ros.offline.evaluation.figures import spread_names, write_name
from cliploc_ros.offline.evaluation.summary import LIMITS_M, Summary
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.page import ACCEPTED, BAD, figure, fold, table
from cliploc_ros.units import NS_PER_S
from demo.truth import TrueFrame, TrueObject, true_ids

#: Greatest distance of a landmark from its object [m]. The objects are at least 0.2 m apart.
NEAR_M = 0.1
PICTURE = 'built_map.png'
_DPI = 110
_MARGIN_M = 0.35
_MISSED = '#E69F00'
_TRUTH = '#222222'
_HEADING_M = 0.2
_NAME_OFFSET_M = 0.2
# Horizontal and vertical map axis of each panel, and the indices of their entries in a symmetric
# matrix that is stored as xx, xy, xz, yy, yz, zz.
_PANELS = ((0, 1, (0, 1, 3)), (0, 2, (0, 2, 5)), (1, 2, (3, 4, 5)))
_AXIS_NAMES = 'xyz'


@dataclass(frozen=True)
class Found:
    """An object with a landmark of its class."""

    object_row: int
    landmark: int
    offset_m: float  #: Error of the landmark's centre [m]
    size_ratio: float  #: Mean radius of the landmark over that of the object


@dataclass(frozen=True)
class MapReview:
    """A map compared with the objects of a room."""

    objects: tuple[TrueObject, ...]
    landmark_map: LandmarkMap
    found: tuple[Found, ...]
    missed: Mapping[int, str]  #: Reason by row of the object
    false: Mapping[int, str]  #: What is there instead, by row of the landmark

    @property
    def landmark_of(self) -> dict[str, str]:
        """Return the id of the landmark of each found object, by the object's id."""
        return {self.objects[hit.object_row].object_id:
                self.landmark_map.landmark_ids[hit.landmark] for hit in self.found}

    def summary(self) -> str:
        """Return the figures in one line."""
        text = (f'{len(self.found)} of {len(self.objects)} objects found, {len(self.missed)} '
                f'missed, {len(self.false)} false')
        if self.found:
            offsets_cm = [100 * hit.offset_m for hit in self.found]
            size_error = np.median([abs(hit.size_ratio - 1) for hit in self.found])
            text += (f'; centres {np.median(offsets_cm):.1f} cm off (median), '
                     f'{max(offsets_cm):.1f} cm at most; sizes {size_error:.0%} off (median)')
        return text


@dataclass(frozen=True)
class Sightings:
    """The number of images that show an object, and of those in which it was detected."""

    shown: int  #: Images that show enough of it
    detected: 'Counter[str]'  #: Images with a detection of it, by the detection's class


def review_map(landmark_map: LandmarkMap, objects: Sequence[TrueObject],
               sightings: Mapping[str, Sightings], left_out: Sequence[Mapping[str, Any]]
               ) -> MapReview:
    """Compare a map with the true objects.

    ``sightings`` is keyed by the object's id; ``left_out`` comes from build_map's report.
    """
    offsets_m = np.linalg.norm(np.array([item.center for item in objects])[:, None]
                               - landmark_map.centers, axis=2)
    is_class = np.array([item.class_id for item in objects])[:, None] == np.array(
        landmark_map.class_ids)
    costs = np.where(is_class & (offsets_m < NEAR_M), offsets_m, 2 * NEAR_M)
    pairs = [(int(row), int(landmark)) for row, landmark in zip(
        *linear_sum_assignment(costs), strict=True) if costs[row, landmark] < NEAR_M]
    # the radius of the sphere of equal volume
    radii = np.cbrt(np.prod(landmark_map.semi_axes, axis=1))
    found = tuple(Found(row, landmark, float(offsets_m[row, landmark]),
                        float(radii[landmark] / np.cbrt(np.prod(objects[row].semi_axes))))
                  for row, landmark in pairs)
    false = {}
    for landmark in sorted(set(range(len(landmark_map))) - {hit.landmark for hit in found}):
        row = int(np.argmin(offsets_m[:, landmark]))
        nearest, offset_m = objects[row], offsets_m[row, landmark]
        if offset_m >= NEAR_M:
            false[landmark] = f'nothing is there; {nearest.object_id} is {offset_m:.2f} m away'
        elif nearest.class_id == landmark_map.class_ids[landmark]:
            false[landmark] = f'a duplicate of {nearest.object_id}'
        else:
            false[landmark] = f'{nearest.object_id} is there: {nearest.label}'
    missed = {}
    for row, item in enumerate(objects):
        if row in {hit.object_row for hit in found}:
            continue
        instead = [landmark_map.class_ids[landmark] for landmark in false
                   if offsets_m[row, landmark] < NEAR_M]
        missed[row] = _why_missed(item, instead, sightings.get(item.object_id), left_out)
    return MapReview(tuple(objects), landmark_map, found, missed, false)


def count_sightings(frames: Sequence[TrueFrame], detections: PosedDetections
                    ) -> dict[str, Sightings]:
    """Count the images that show each object, and its detections by class."""
    stamps_ns = np.round(detections.stamps_s * NS_PER_S)
    shown: Counter[str] = Counter()
    detected: dict[str, Counter[str]] = {}
    for frame in frames:
        shown.update(box.object_id for box in frame.boxes)
        stamp_ns = parse_stamp_ns(frame.timestamp, 'truth.json')
        number = int(np.argmin(np.abs(stamps_ns - stamp_ns)))
        if abs(stamps_ns[number] - stamp_ns) > 1e3:  # the detections hold a stamp as a float
            continue  # not a keyframe
        rows = slice(*detections.frame_offsets[number:number + 2])
        ids = true_ids(detections.bboxes_xyxy[rows], frame.boxes)
        for object_id, class_number in sorted(set(zip(ids, detections.classes[rows],
                                                      strict=True))):
            detected.setdefault(object_id, Counter())[detections.class_names[class_number]] += 1
    return {object_id: Sightings(count, detected.get(object_id, Counter()))
            for object_id, count in shown.items()}


def _why_missed(item: TrueObject, instead: Sequence[str], seen: Sightings | None,
                left_out: Sequence[Mapping[str, Any]]) -> str:
    """Return the first applicable cause, and how often the object was detected."""
    if seen is None:
        return 'no image shows it'
    names = ', '.join(f'{count} as {name}' for name, count in seen.detected.most_common())
    sightings = f'{seen.shown} images show it; detected in {names or "none"}'
    if instead:
        return f'mapped as {instead[0]}; {sightings}'
    near = [entry for entry in left_out
            if np.linalg.norm(np.array(entry['center']) - item.center) < NEAR_M]
    if near:
        best = max(near, key=lambda entry: entry['class_id'] == item.class_id)
        return f'left out as {best["class_id"]}, {best["reason"]}; {sightings}'
    return sightings


def console_lines(review: MapReview) -> Iterator[str]:
    """Yield the comparison of the built map with the room."""
    yield review.summary()
    for row, reason in review.missed.items():
        yield f'  missed: {review.objects[row].object_id}: {reason}'
    for landmark, instead in review.false.items():
        yield f'  false: {review.landmark_map.landmark_ids[landmark]}: {instead}'


def success_lines(summaries: Mapping[str, Summary]) -> Iterator[str]:
    """Yield the lines of the table that compares success in both maps."""
    for row in _success_rows(summaries):
        yield '  '.join(cell.ljust(13) for cell in row).rstrip()


def _success_rows(summaries: Mapping[str, Summary]) -> list[tuple[str, ...]]:
    return [('', *(f'within {limit:g} m' for limit in LIMITS_M), 'median error', 'accepted',
             'false accepts'),
            *((name, *(f'{summary.success(limit):.2f}' for limit in LIMITS_M),
               f'{np.median(summary.errors_m):.3f} m',
               f'{summary.accepted.sum()} of {summary.errors_m.size}',
               str(summary.false_accepts())) for name, summary in summaries.items())]


def section(review: MapReview, summaries: Mapping[str, Summary], images: int) -> str:
    """Return the page's section on the built map, as HTML."""
    objects, landmark_map = review.objects, review.landmark_map
    head, *rows = _success_rows(summaries)
    parts = [
        f'<p><code>build_map</code> built this map from {images} images of a mapping walk and '
        'their poses. Between the walk and the wake-ups, objects moved and the light changed. '
        f'An object is found if a landmark of its class lies within {NEAR_M * 100:.0f} cm of '
        'it. All other landmarks are false.</p>',
        figure(PICTURE, 'Found, missed and false objects. The dotted line is the mapping walk.',
               'built map and true objects from three sides'),
        '<p>One localization of each image of the wake-ups, in the built and in the true map:</p>',
        table(head, rows)]
    if review.missed:
        parts += ['<h2>Missed objects</h2>', table(('object', 'label', 'reason'), (
            (objects[row].object_id, objects[row].label, reason)
            for row, reason in review.missed.items()))]
    if review.false:
        parts += ['<h2>False objects</h2>', table(('landmark', 'label', 'object at its place'), (
            (landmark_map.landmark_ids[landmark], landmark_map.labels[landmark], instead)
            for landmark, instead in review.false.items()))]
    found = table(
        ('object', 'true label', 'landmark', 'label in the map', '#position error', '#size error'),
        ((objects[hit.object_row].object_id, objects[hit.object_row].label,
          landmark_map.landmark_ids[hit.landmark], landmark_map.labels[hit.landmark],
          f'{hit.offset_m * 100:.1f} cm', f'{hit.size_ratio - 1:+.0%}')
         for hit in sorted(review.found, key=lambda hit: -hit.offset_m)))
    return fold(f'The built map: {review.summary()}', *parts,
                fold('All found objects, the least accurate first', found))


def draw_map_review(review: MapReview, map_from_camera: NDArray[np.float64], path: Path) -> None:
    """Draw found, missed and false objects, and the poses (F, 4, 4) of the mapping walk."""
    points = np.concatenate([[item.center for item in review.objects], review.landmark_map.centers,
                             map_from_camera[:, :3, 3]])
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    extents = high - low
    drawn = Figure(figsize=(13.0, 1.0 + 13.0 * (extents[1] + extents[2]) / extents[:2].sum()),
                    dpi=_DPI, layout='constrained')
    grid = drawn.add_gridspec(2, 2, height_ratios=(extents[1], extents[2]),
                               width_ratios=(extents[0], extents[1]))
    for place, (across, up, entries) in zip((grid[0, 0], grid[1, 0], grid[1, 1]), _PANELS,
                                            strict=True):
        axes = drawn.add_subplot(place)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect='equal',
                 xlabel=f'{_AXIS_NAMES[across]} [m]', ylabel=f'{_AXIS_NAMES[up]} [m]')
        axes.grid(color='#EEEEEE', zorder=0)
        _draw_panel(axes, review, (across, up), entries)
        if up == 1:
            # Draw the camera's positions and viewing directions.
            positions, forward = map_from_camera[:, :2, 3], map_from_camera[:, :2, 2]
            axes.plot(*positions.T, ':', color='#888888', linewidth=1.0, zorder=2)
            axes.plot(*positions.T, '.', color='#666666', markersize=5, zorder=2)
            for start, end in zip(positions, positions + _HEADING_M * forward, strict=True):
                axes.plot(*zip(start, end, strict=True), color='#666666', linewidth=0.9, zorder=2)
    legend = drawn.add_subplot(grid[0, 1])
    legend.set_axis_off()
    legend.legend(loc='upper left', frameon=False, fontsize=11, handles=[
        Patch(facecolor=ACCEPTED, alpha=0.45, label=f'correct landmark: {len(review.found)}'),
        Patch(facecolor=BAD, alpha=0.45, label=f'false landmark: {len(review.false)}'),
        Patch(facecolor='none', edgecolor=_MISSED, linewidth=2.0,
              label=f'missed object: {len(review.missed)}'),
        Patch(facecolor='none', edgecolor=_TRUTH, linewidth=0.6, label='true object'),
        Line2D([], [], color='#666666', marker='.', linestyle=':',
               label='mapping walk and viewing directions')])
    spread_names(drawn)
    write_file(path, drawn.savefig)


def _draw_panel(axes: Axes, review: MapReview, plane: tuple[int, int],
                entries: tuple[int, int, int]) -> None:
    landmark_map = review.landmark_map
    for landmark, (center, shape) in enumerate(zip(landmark_map.centers, landmark_map.shapes,
                                                   strict=True)):
        color = BAD if landmark in review.false else ACCEPTED
        outline = outline_points(np.array([*center[[*plane]], *shape[[*entries]]]))
        axes.add_patch(Polygon(outline, closed=True, facecolor=color, edgecolor='none', alpha=0.45,
                               zorder=4 if landmark in review.false else 3))
    shapes = shape_matrices(np.array([item.semi_axes for item in review.objects]),
                            np.array([item.orientation for item in review.objects]))
    for row, (item, shape) in enumerate(zip(review.objects, shapes, strict=True)):
        is_missed = row in review.missed
        outline = outline_points(np.array([*item.center[[*plane]], *shape[[*entries]]]))
        axes.add_patch(Polygon(outline, closed=True, fill=False, zorder=6 if is_missed else 5,
                               edgecolor=_MISSED if is_missed else _TRUTH,
                               linewidth=2.0 if is_missed else 0.6))
        if is_missed:
            write_name(axes, item.center[[*plane]] + (0.0, _NAME_OFFSET_M), item.object_id,
                       color='#8A5A00')
    for landmark in review.false:
        write_name(axes, landmark_map.centers[landmark, [*plane]] - (0.0, _NAME_OFFSET_M),
                   landmark_map.landmark_ids[landmark], color=BAD)
