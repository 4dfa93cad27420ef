# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page of the check of a map, with its figures, pictures, and the advice.

The page begins with the main results. Each piece of advice has an image of the recording: the best
view of a landmark, or the nearest view.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import counted
from cliploc_ros.files.storage import write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation import figures
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.check.findings import RADIUS_M, LandmarkCheck
from cliploc_ros.offline.mapping.check.relocalization import ImageOf, Trial, count_verdicts
from cliploc_ros.offline.mapping.check.report import MEASURES, SERIOUS, Advice, CheckReport
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.sightings import crop_around, find_sightings, outlines_in_view
from cliploc_ros.offline.mapping.views import make_views

CHECK, CHECK_DATA = 'check.html', 'check.json'
# Words and colour of each grade of a landmark.
_GRADES = {'faulty': ('serious fault', html.MISLED), 'minor': ('minor fault', html.REFUSED),
           'sound': ('sound', '#009E73')}
_MOST_LANDMARKS = 300
# Number of pieces of advice on the first screen.
_FIRST_ADVICE = 3
_DPI = 120
_INK = '#222222'
_HEAT = LinearSegmentedColormap.from_list('accepted', ['#D3EBFA', '#56B4E9', '#003E6B']
                                          ).with_extremes(bad='#DDDDDD')
_MARKERS = {'accepted': (html.ACCEPTED, 'o'), 'refused': (html.REFUSED, 's'),
            'misled': (html.MISLED, 'X')}
_MOST_NAMES, _MOST_LOOK_ALIKES = 30, 6
# Margin of a picture around a landmark, in sizes of the landmark.
_AROUND = 3.0
# Angle that makes a view as different as 1 m does [deg]; greatest difference of a view that is
# shown for another one [m].
_DEGREES_PER_M, _MOST_DIFFERENT = 30.0, 3.0
_WIDTH_PX = 480
_BOX_RGB, _OUTLINE_RGB = (255, 255, 255), (230, 159, 0)


def write_check(folder: Path, name: str, landmark_map: LandmarkMap, report: CheckReport,
                detections: PosedDetections | None = None, image_of: ImageOf | None = None
                ) -> None:
    """Write the page and the JSON file of the check of a map, each atomically.

    OptionsError: a file cannot be written; the old file stays.
    """
    write_text(folder / CHECK_DATA, json.dumps(_plain({'map': name, **_data(report)}), indent=1,
                                               allow_nan=False))
    write_text(folder / CHECK, check_page(name, landmark_map, report, detections, image_of))


def _data(report: CheckReport) -> dict[str, Any]:
    """Return the content of the JSON file."""
    grid, recording = report.grid, report.recording
    return {
        **{name: getattr(report, name) for name in (
            'passed', 'verdict', 'summary', 'advice', 'notes', 'duplicates', 'landmarks',
            'look_alikes', 'keyframes')},
        'measures': {measure.key: measure._asdict() for measure in report.measures},
        'scale_by_sizes': report.scale,
        'overlaps': [{'first': report.map_ids[overlap.first],
                      'second': report.map_ids[overlap.second], 'distance': overlap.distance,
                      'is_duplicate': overlap.is_duplicate} for overlap in report.overlaps],
        'recording': None if recording is None else {
            **vars(recording), 'verdicts': count_verdicts(recording.trials)},
        'grid': {**vars(grid), 'poses': None, 'verdicts': count_verdicts(grid.trials),
                 'trials': [trial for trial in grid.trials if trial.verdict == 'misled']}}


def _plain(value: Any) -> Any:
    """Return a value as a JSON tree: not finite numbers as None, trials without their results."""
    if is_dataclass(value):
        value = {key: item for key, item in vars(value).items()
                 if not (key == 'result' and isinstance(value, Trial))}
    if isinstance(value, np.ndarray | np.generic):
        value = value.round(4).tolist() if value.dtype.kind == 'f' else value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _grade(landmark: LandmarkCheck) -> str:
    """Return the grade of a landmark: 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


def check_page(name: str, landmark_map: LandmarkMap, report: CheckReport,
               detections: PosedDetections | None = None, image_of: ImageOf | None = None) -> str:
    """Return the page of the check of a map; advice has pictures if there are images."""
    views: list[tuple[bytes, str] | None] = [None] * len(report.to_do)
    if detections is not None and image_of is not None:
        shown = group_boxes(associate(make_views(detections), landmarks_of_map(
            landmark_map, detections.class_names)), len(landmark_map))
        views = [_view_of(advice, landmark_map, detections, shown, image_of)
                 for advice in report.to_do]
    verdict, *localized = report.summary
    said = html.verdict(verdict, report.passed) + html.items(localized)
    first, *others = (html.figure(png, caption, picture)
                      for picture, caption, png in draw_pictures(landmark_map, report))
    cards = [html.card(f'{number}. {text}', *(view or ()))
             for number, (text, view) in enumerate(zip(report.advice, views, strict=True), 1)]
    parts = [html.first_screen(
        [said, html.bars((MEASURES[measure.key], str(measure), measure.share, measure.limit,
                          not measure.is_missed) for measure in report.measures),
         '<h2>What to do first</h2>', *cards[:_FIRST_ADVICE]], [first])]
    if later := cards[_FIRST_ADVICE:]:
        parts.append(html.fold(counted(len(later), 'more recommendation'), *later))
    faulty = sum(_grade(landmark) == 'faulty' for landmark in report.landmarks)
    parts += [html.fold('All figures', html.table(('', ''), figures_of(report))),
              html.fold('Pictures', *others),
              html.fold(f'Landmarks, worst first: {faulty} of {len(report.landmarks)} with a '
                        'serious fault', _landmarks(report.landmarks))]
    return html.page(f'Check of {name}', *parts,
                     html.fold('How these figures were computed', html.items(report.notes)))


def figures_of(report: CheckReport) -> list[tuple[str, str]]:
    """Return the names and values of the figures of a check that have no threshold."""
    counts = count_verdicts(report.grid.trials)
    rows = [('landmarks', str(len(report.landmarks))), ('keyframes', str(report.keyframes)),
            ('duplicates', counted(report.duplicates, 'pair')),
            ('places that look alike', counted(len(report.look_alikes), 'pair')),
            (f'simulated views of objects alone, {len(report.grid.trials)} on the grid',
             ', '.join(f'{count} {verdict}' for verdict, count in counts.items()))]
    if (recording := report.recording) is not None:
        rows += [('recording', f'{counted(recording.frames, "frame")}, '
                  f'{counted(recording.boxes, "box")}, {recording.duration_s:.0f} s'),
                 ('boxes that landmarks of the other views explain',
                  f'{recording.held_out.explained:.0%}, median IoU '
                  f'{recording.held_out.median_iou:.2f}')]
    return rows


def _landmarks(landmarks: Sequence[LandmarkCheck]) -> str:
    rows: list[list[str | tuple[str, str]]] = []
    for check in landmarks[:_MOST_LANDMARKS]:
        frames = (f'{check.seen} of {check.expected}' if check.expected is not None else
                  '' if check.support is None else str(check.support))
        label = (check.class_id if check.label == check.class_id
                 else f'{check.label} ({check.class_id})')
        faults = '; '.join(check.faults) if check.faults else _GRADES['sound'][0]
        rows.append([(check.landmark_id, _grade(check)), (label, 'text'), (faults, 'text'),
                     frames])
    return html.table(('landmark', 'label', 'faults', '#frames'), rows) + html.note(
        'frames: how many of the frames that should show the landmark have a detection of it. '
        f' {CHECK_DATA} has all figures of all {len(landmarks)} landmarks.')


# ---- the map from above -------------------------------------------------------------------------

def draw_pictures(landmark_map: LandmarkMap, report: CheckReport
                  ) -> Iterator[tuple[str, str, bytes]]:
    """Yield the name, the caption and the PNG of each picture."""
    yield ('grid', 'Where a robot is localized, top view. Outlines are landmarks, a cell is a '
           'camera position. Its shade shows the share of headings that localize: with a correct, '
           'accepted pose by simulated objects, or within reach of a keyframe; it is grey without '
           'such a heading. Ticks show the headings at which a wrong pose was accepted. Positions '
           'inside landmarks are omitted.' + (
               ' Numbers are those of the advice.' if _places(landmark_map, report) else ''),
           _drawn(_draw_grid, landmark_map, report))
    yield ('landmarks', f'Top view of the landmarks. The {_MOST_NAMES} worst with a fault are '
           'named. Arrows are recorded views, each relocalized in a map of the other views; a '
           'line leads to a wrong pose. Circles of one number are places that look alike.',
           _drawn(_draw_landmarks, landmark_map, report))


def _drawn(draw: Callable[[Axes, LandmarkMap, CheckReport], None], landmark_map: LandmarkMap,
           report: CheckReport) -> bytes:
    """Return a picture with the bounds of the grid and of the landmarks."""
    positions, half = report.grid.positions[:, :2], report.grid.spacing_m / 2
    points = [landmark_map.centers[:, :2], positions - half, positions + half]
    if report.recording is not None:
        points.append(report.recording.path_xyz[:, :2])
    figure, axes = figures.new_top_view(np.concatenate(points), landmark_map.frame_id)
    if report.recording is not None:
        axes.plot(*points[-1].T, color=_INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=4,
                  path_effects=figures.EDGED, label='path of the recording')
    draw(axes, landmark_map, report)
    handles = axes.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc='outside lower center', ncols=min(3, len(handles)),
                  frameon=False, fontsize=9)
    return figures.png_of(figure, _DPI)


def _draw_grid(axes: Axes, landmark_map: LandmarkMap, report: CheckReport) -> None:
    grid, side = report.grid, report.grid.spacing_m
    height = grid.positions[0, 2] if len(grid.positions) else 0.0
    axes.set_title(f'Where a robot is localized, camera {height:z.2f} m high', fontsize=12)
    cells = PatchCollection(
        [Rectangle(position[:2] - 0.48 * side, 0.96 * side, 0.96 * side)
         for position in grid.positions], cmap=_HEAT, norm=Normalize(0, 100), zorder=1)
    cells.set_array(np.ma.masked_equal(100.0 * grid.localized / grid.headings, 0.0))
    axes.add_collection(cells)
    axes.figure.colorbar(cells, ax=axes, shrink=0.7, pad=0.02).set_label(
        'localized by objects or keyframes\n[% of headings]', fontsize=9)
    for center, shape in zip(landmark_map.centers, landmark_map.shapes, strict=True):
        figures.draw_outline(axes, center, shape, facecolor='none', edgecolor=_INK, linewidth=0.7,
                             zorder=3, path_effects=figures.EDGED)
    ticks = [(trial.position, trial.position + 0.45 * side * trial.forward, np.full(3, np.nan))
             for trial in grid.trials if trial.verdict == 'misled']
    axes.plot(*np.reshape(ticks, (-1, 3)).T[:2], 'X-', color=html.MISLED, markevery=3, zorder=7,
              markersize=9, markeredgecolor='white', linewidth=2.5,
              label=f'misled ({len(ticks)} of {len(grid.trials)} simulated views)')
    for number, place in _places(landmark_map, report).items():
        axes.text(place[0], place[1], str(number), fontsize=10, fontweight='bold', zorder=10,
                  color='white', ha='center', va='center', bbox={
                      'boxstyle': 'circle,pad=0.25', 'facecolor': _INK, 'edgecolor': 'white'})


def _places(landmark_map: LandmarkMap, report: CheckReport) -> dict[int, NDArray[np.float64]]:
    """Return the places (3,) [m] of the first pieces of advice that have one, by their numbers."""
    centers = dict(zip(landmark_map.landmark_ids, landmark_map.centers, strict=True))
    places = {number: centers[advice.landmarks[0]] if advice.landmarks
              else None if advice.view is None else advice.view.position
              for number, advice in enumerate(report.to_do[:_FIRST_ADVICE], start=1)}
    return {number: place for number, place in places.items() if place is not None}


def _draw_landmarks(axes: Axes, landmark_map: LandmarkMap, report: CheckReport) -> None:
    grades = {check.landmark_id: _grade(check) for check in report.landmarks}
    for name, center, shape in zip(landmark_map.landmark_ids, landmark_map.centers,
                                   landmark_map.shapes, strict=True):
        figures.draw_outline(axes, center, shape, facecolor=_GRADES[grades[name]][1], alpha=0.6,
                             edgecolor=_INK, linewidth=0.7, zorder=3)
    counts = Counter(grades.values())
    for name, (words, color) in _GRADES.items():
        axes.plot([], [], 'o', color=color, alpha=0.6, markersize=9,
                  label=f'{words} ({counts[name]})')
    for check in [check for check in report.landmarks if check.faults][:_MOST_NAMES]:
        figures.write_name(axes, check.center[:2], check.landmark_id)
    trials = report.recording.trials if report.recording is not None else ()
    axes.set_title('Landmarks and recorded views' if trials else 'Landmarks', fontsize=12)
    for verdict, (color, marker) in _MARKERS.items() if trials else ():
        chosen = [trial for trial in trials if trial.verdict == verdict]
        tips, forward = (np.reshape([getattr(trial, name)[:2] for trial in chosen], (-1, 2)).T
                         for name in ('position', 'forward'))
        axes.plot(*tips, marker, color=color, markersize=5, zorder=6, label=(
            f'view {verdict} ({len(chosen)})'))
        axes.quiver(*tips, *forward, color=color, angles='xy', scale=25.0, width=0.004, zorder=5)
        for trial in chosen if verdict == 'misled' else ():
            axes.plot(*np.array([trial.position, trial.estimate]).T[:2], color=color, zorder=7)
    for number, pair in enumerate(report.look_alikes[:_MOST_LOOK_ALIKES], start=1):
        for x, y, _ in (pair.first, pair.second):
            axes.add_patch(Circle((x, y), RADIUS_M, fill=False, edgecolor=html.LOOK_ALIKE,
                                  linewidth=1.8, zorder=5))
            axes.text(x, y + 0.8 * RADIUS_M, str(number), fontsize=11, fontweight='bold',
                      ha='center', va='center', zorder=9, path_effects=figures.EDGED, clip_on=True)


# ---- recorded views -----------------------------------------------------------------------------

def _view_of(advice: Advice, landmark_map: LandmarkMap, detections: PosedDetections,
             shown: Sequence[NDArray[np.int64]], image_of: ImageOf) -> tuple[bytes, str] | None:
    """Return a JPEG of the view that shows best what the advice is about, and its caption.

    That is the best view of a landmark, with its outline and the boxes, or the view nearest to
    that of the advice. ``shown`` are the boxes of each landmark. None: no image shows it.
    """
    rows = [landmark_map.landmark_ids.index(landmark) for landmark in advice.landmarks]
    words, frames = 'the nearest recorded view', list[int]()
    if rows:
        words = 'outlined: ' + ' and '.join(advice.landmarks)
        frames = [sighting.view for sighting in find_sightings(
            detections, shown[rows[0]], landmark_map.centers[rows[0]],
            landmark_map.shapes[rows[0]], len(detections))]
    elif advice.view is not None:
        poses = detections.map_from_camera
        cosines = np.clip(poses[:, :3, 2] @ advice.view.forward, -1.0, 1.0)
        different = (np.linalg.norm(poses[:, :3, 3] - advice.view.position, axis=1)
                     + np.degrees(np.arccos(cosines)) / _DEGREES_PER_M)
        frames = [frame for frame in np.argsort(different).tolist()
                  if different[frame] < _MOST_DIFFERENT]
    found = next(((frame, image) for frame in frames
                  if (image := image_of(frame)) is not None), None)
    if found is None:
        return None
    frame, image = found
    outlines = outlines_in_view(detections, frame, landmark_map.centers[rows],
                                landmark_map.shapes[rows])
    drawn, thin = image.copy(), 1 + image.shape[1] // 640
    boxes = detections.detections_of(frame).bboxes_xyxy.reshape(-1, 2, 2)
    for first, second in np.rint(boxes).astype(int).tolist():
        cv2.rectangle(drawn, first, second, _BOX_RGB, thin, cv2.LINE_AA)
    for outline in outlines[np.isfinite(outlines).all(axis=1)]:
        points = np.rint(outline_points(outline)).clip(-9999, 9999).astype(np.int32)
        cv2.polylines(drawn, [points], True, _OUTLINE_RGB, 2 * thin, cv2.LINE_AA)
    if rows:  # a crop, so that a small landmark is visible
        drawn = crop_around(drawn, ellipse_bboxes(outlines[:1])[0], _AROUND)
    seconds = detections.stamps_s[frame] - detections.stamps_s[0]
    return html.jpeg_of(drawn, _WIDTH_PX), f'{words}; image at {seconds:.0f} s'
