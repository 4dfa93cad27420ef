# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of a check: the map from above, and the recorded views beside the advice."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation.figures import (
    EDGED,
    draw_outline,
    new_top_view,
    png_of,
    write_name,
)
from cliploc_ros.offline.evaluation.pages import FIRST_ADVICE, GRADES, grade
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.check.findings import RADIUS_M
from cliploc_ros.offline.mapping.check.relocalization import ImageOf, refused_spans
from cliploc_ros.offline.mapping.check.report import Advice, CheckReport
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.sightings import crop_around, find_sightings, outlines_in_view
from cliploc_ros.offline.mapping.views import make_views

_DPI = 120
_INK, _GREY = '#222222', '#555555'
_HEAT = LinearSegmentedColormap.from_list('accepted', ['#FBE9C6', '#56B4E9', '#003E6B']
                                          ).with_extremes(bad='#DDDDDD')
_MARKERS = {'accepted': (html.ACCEPTED, 'o'), 'refused': (html.REFUSED, 's'),
            'misled': (html.MISLED, 'X')}
_MOST_NAMES, _MOST_LOOK_ALIKES, _MOST_TIMES = 30, 6, 8
# Margin of a picture around a landmark, in sizes of the landmark.
_AROUND = 3.0
# Angle that makes a view as different as 1 m does [deg]; greatest difference of a view that is
# shown for another one [m].
_DEGREES_PER_M, _MOST_DIFFERENT = 30.0, 3.0
_WIDTH_PX = 480
_BOX_RGB, _OUTLINE_RGB = (255, 255, 255), (230, 159, 0)


# ---- the map from above -------------------------------------------------------------------------

def draw_pictures(landmark_map: LandmarkMap, report: CheckReport
                  ) -> Iterator[tuple[str, str, bytes]]:
    """Yield the name, the caption and the PNG of each picture."""
    yield ('grid', 'Expected relocalization, top view. Outlines are landmarks, a cell is a camera '
           'position. Its shade shows the share of headings with a correct, accepted pose, among '
           'the headings with three or more detectable landmarks; it is grey if no heading shows '
           'three. Ticks show the headings at which a wrong pose was accepted. Positions inside '
           'landmarks are omitted. Numbers refer to the advice.',
           _drawn(_draw_grid, landmark_map, report))
    yield ('landmarks', 'Top view of the landmarks. Landmarks with a fault are named; if there '
           'are many, only those with a serious fault. Arrows are recorded frames, each '
           'relocalized in a map that was fitted without the frames of that time; a line leads to '
           'a wrong pose. Times mark the longest sequences of refused frames. Circles of one '
           'number are places that look alike.', _drawn(_draw_landmarks, landmark_map, report))


def _drawn(draw: Callable[[Axes, LandmarkMap, CheckReport], None], landmark_map: LandmarkMap,
           report: CheckReport) -> bytes:
    """Return a picture with the bounds of the grid and of the landmarks."""
    positions, half = report.grid.positions[:, :2], report.grid.spacing_m / 2
    points = [landmark_map.centers[:, :2], positions - half, positions + half]
    if report.recording is not None:
        points.append(report.recording.path_xyz[:, :2])
    figure, axes = new_top_view(np.concatenate(points), landmark_map.frame_id)
    if report.recording is not None:
        axes.plot(*points[-1].T, color=_INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=4,
                  path_effects=EDGED, label='path of the recording')
    draw(axes, landmark_map, report)
    handles = axes.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc='outside lower center', ncols=min(3, len(handles)),
                  frameon=False, fontsize=9)
    return png_of(figure, _DPI)


def _draw_grid(axes: Axes, landmark_map: LandmarkMap, report: CheckReport) -> None:
    grid, side = report.grid, report.grid.spacing_m
    height = grid.positions[0, 2] if len(grid.positions) else 0.0
    axes.set_title(f'Expected accepted poses, camera {height:.2f} m high', fontsize=12)
    cells = PatchCollection(
        [Rectangle(position[:2] - 0.48 * side, 0.96 * side, 0.96 * side)
         for position in grid.positions], cmap=_HEAT, norm=Normalize(0, 100), zorder=1,
        edgecolors=[_GREY if is_near and report.recording is not None else 'none'
                    for is_near in grid.is_near], linewidths=0.6)
    cells.set_array(np.ma.masked_where(
        (grid.useful == 0) & (grid.accepted == 0),
        100.0 * np.minimum(1.0, grid.accepted / np.maximum(1, grid.useful))))
    axes.add_collection(cells)
    figure = axes.figure
    assert isinstance(figure, Figure)
    figure.colorbar(cells, ax=axes, shrink=0.7, pad=0.02).set_label(
        'correct pose accepted\n[% of headings that show 3 landmarks]', fontsize=9)
    for center, shape in zip(landmark_map.centers, landmark_map.shapes, strict=True):
        draw_outline(axes, center, shape, facecolor='none', edgecolor='#444444', linewidth=0.7,
                     zorder=3, path_effects=EDGED)
    ticks = [(trial.position, trial.position + 0.45 * side * trial.forward, np.full(3, np.nan))
             for trial in grid.trials if trial.verdict == 'misled']
    axes.plot(*np.reshape(ticks, (-1, 3)).T[:2], 'X-', color=html.MISLED, markevery=3, zorder=7,
              markersize=9, markeredgecolor='white', linewidth=2.5,
              label=f'misled ({len(ticks)} of {len(grid.trials)} views)')
    if report.recording is not None:
        axes.plot([], [], 's', markerfacecolor='white', markeredgecolor=_GREY,
                  label='near the recording')
    rows = {name: row for row, name in enumerate(landmark_map.landmark_ids)}
    for number, advice in enumerate(report.to_do[:FIRST_ADVICE], start=1):
        place = (landmark_map.centers[rows[advice.landmarks[0]]] if advice.landmarks
                 else None if advice.view is None else advice.view.position)
        if place is not None:
            axes.text(place[0], place[1], str(number), fontsize=10, fontweight='bold', zorder=10,
                      color='white', ha='center', va='center', bbox={
                          'boxstyle': 'circle,pad=0.25', 'facecolor': _INK, 'edgecolor': 'white'})


def _draw_landmarks(axes: Axes, landmark_map: LandmarkMap, report: CheckReport) -> None:
    grades = {check.landmark_id: grade(check) for check in report.landmarks}
    for name, center, shape in zip(landmark_map.landmark_ids, landmark_map.centers,
                                   landmark_map.shapes, strict=True):
        draw_outline(axes, center, shape, facecolor=GRADES[grades[name]][1], alpha=0.6,
                     edgecolor='#444444', linewidth=0.7, zorder=3)
    counts = Counter(grades.values())
    for name, (words, color) in GRADES.items():
        axes.plot([], [], 'o', color=color, alpha=0.6, markersize=9,
                  label=f'{words} ({counts[name]})')
    named = [check for check in report.landmarks if check.faults]
    if len(named) > _MOST_NAMES:
        named = [check for check in named if grade(check) == 'faulty'][:_MOST_NAMES]
    for check in named:
        write_name(axes, check.center[:2], check.landmark_id)
    trials = report.recording.trials if report.recording is not None else ()
    axes.set_title('Landmarks and recorded frames' if trials else 'Landmarks', fontsize=12)
    for verdict, (color, marker) in _MARKERS.items() if trials else ():
        chosen = [trial for trial in trials if trial.verdict == verdict]
        tips = np.reshape([trial.position[:2] for trial in chosen], (-1, 2))
        axes.plot(*tips.T, marker, color=color, markersize=5, zorder=6, label=(
            f'frame {verdict} ({len(chosen)})'))
        axes.quiver(*tips.T, *np.reshape([trial.forward[:2] for trial in chosen], (-1, 2)).T,
                    color=color, angles='xy', scale=25.0, width=0.004, zorder=5)
        for trial in chosen if verdict == 'misled' else ():
            axes.plot(*np.array([trial.position, trial.estimate]).T[:2], color=color, zorder=7)
    for run in [run for run in refused_spans(trials) if len(run) > 1][:_MOST_TIMES]:
        middle = run[len(run) // 2]
        axes.annotate(f'{(middle.stamp_s or 0.0) - (trials[0].stamp_s or 0.0):.0f} s',
                      tuple(middle.position[:2]), tuple(-14.0 * middle.forward[:2]),
                      textcoords='offset points', ha='center', va='center', fontsize=8,
                      path_effects=EDGED, zorder=9)
    for number, pair in enumerate(report.look_alikes[:_MOST_LOOK_ALIKES], start=1):
        for x, y, _ in (pair.first, pair.second):
            axes.add_patch(Circle((x, y), RADIUS_M, fill=False, edgecolor=html.LOOK_ALIKE,
                                  linewidth=1.8, zorder=5))
            axes.text(x, y + 0.8 * RADIUS_M, str(number), fontsize=11, fontweight='bold',
                      ha='center', va='center', zorder=9, path_effects=EDGED, clip_on=True)


# ---- recorded views -----------------------------------------------------------------------------

class ViewPainter:
    """Draws views of a recording, with its boxes and the outlines of landmarks."""

    def __init__(self, landmark_map: LandmarkMap, detections: PosedDetections, image_of: ImageOf):
        self._map, self._detections, self._image_of = landmark_map, detections, image_of

    @cached_property
    def _shown(self) -> list[NDArray[np.int64]]:
        """Return the boxes that show each landmark."""
        return group_boxes(associate(
            make_views(self._detections),
            landmarks_of_map(self._map, self._detections.class_names)), len(self._map))

    def of(self, advice: Advice) -> tuple[bytes, str] | None:
        """Return a JPEG of the view that shows best what the advice is about, and its caption.

        That is the best view of a landmark, or the view nearest to that of the advice. None: no
        image shows it.
        """
        detections, rows, words = self._detections, [], 'the nearest recorded view'
        if advice.landmarks:
            rows = [self._map.landmark_ids.index(landmark) for landmark in advice.landmarks]
            words = 'outlined: ' + ' and '.join(advice.landmarks)
            frames = [sighting.view for sighting in find_sightings(
                detections, self._shown[rows[0]], self._map.centers[rows[0]],
                self._map.shapes[rows[0]], len(detections))]
        elif advice.view is not None:
            poses = detections.map_from_camera
            far_m = np.linalg.norm(poses[:, :3, 3] - advice.view.position, axis=1)
            cosines = np.clip(poses[:, :3, 2] @ advice.view.forward, -1.0, 1.0)
            different = far_m + np.degrees(np.arccos(cosines)) / _DEGREES_PER_M
            order = np.argsort(different)
            frames = order[different[order] < _MOST_DIFFERENT].tolist()
        else:
            return None
        for frame in frames:
            if (image := self._image_of(frame)) is not None:
                seconds = detections.stamps_s[frame] - detections.stamps_s[0]
                return self._draw(image, frame, rows), f'{words}; image at {seconds:.0f} s'
        return None

    def _draw(self, image: NDArray[np.uint8], frame: int, rows: Sequence[int]) -> bytes:
        """Return the image of a frame as JPEG, around the first of the outlined landmarks."""
        outlines = outlines_in_view(self._detections, frame, self._map.centers[rows],
                                    self._map.shapes[rows])
        drawn, thin = image.copy(), 1 + image.shape[1] // 640
        boxes = self._detections.detections_of(frame).bboxes_xyxy.reshape(-1, 2, 2)
        for first, second in np.rint(boxes).astype(int).tolist():
            cv2.rectangle(drawn, first, second, _BOX_RGB, thin, cv2.LINE_AA)
        for outline in outlines[np.isfinite(outlines).all(axis=1)]:
            points = np.rint(outline_points(outline)).clip(-9999, 9999).astype(np.int32)
            cv2.polylines(drawn, [points], True, _OUTLINE_RGB, 2 * thin, cv2.LINE_AA)
        # a crop, so that a small landmark is visible
        return html.jpeg_of(crop_around(drawn, ellipse_bboxes(outlines[:1])[0], _AROUND)
                            if rows else drawn, _WIDTH_PX)
