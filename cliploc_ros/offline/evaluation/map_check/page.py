# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a check: figures as JSON; a page whose first screen says all, the rest folded.

Beside an advice are the room's own images: a landmark in its best view, or the nearest view.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    outline_points,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.files import page as html
from cliploc_ros.files.storage import write_text
from cliploc_ros.offline.mapping.check.landmark_faults import LandmarkCheck
from cliploc_ros.offline.mapping.check.relocalization import Trial, count_verdicts
from cliploc_ros.offline.mapping.check.report import (
    SERIOUS,
    Advice,
    CheckReport,
    Measure,
    RecordingCheck,
    count_by_objects,
    share,
)
from cliploc_ros.offline.mapping.landmarks import box_iou
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

#: Returns the image (h, w, 3), red first, of a time [s] and a camera, as a pinhole shows it.
ReadImage = Callable[[float, str, Camera], NDArray[np.uint8] | None]
_MOST_FRAMES = 600
# A landmark that fills this share of the image is large enough.
_LARGE = 0.04
_OWN_IOU = 0.3
# A picture of a landmark is this many times as large as it.
_AROUND = 3.0
# An angle that makes a view as different as a metre does [deg]; what is the same view, and a view
# that is too different [m].
_DEGREES_PER_M, _SAME, _MOST_DIFFERENT = 30.0, 0.1, 3.0
_WIDTH_PX, _JPEG_QUALITY = 480, 75
_BOX_RGB, _OUTLINE_RGB = (255, 255, 255), (230, 159, 0)


class Picture(NamedTuple):
    """A picture of a recorded view."""

    jpeg: bytes
    caption: str


class ViewPainter:
    """Draws views of a recording, with its boxes and the outlines of landmarks."""

    def __init__(self, landmark_map: LandmarkMap, detections: PosedDetections, read: ReadImage):
        self._map, self._detections, self._read = landmark_map, detections, read

    def of(self, advice: Advice) -> Picture | None:
        """Return the view that shows best what an advice is about; None where there is none."""
        if advice.landmarks:
            rows = [self._map.landmark_ids.index(one) for one in advice.landmarks]
            found = self._showing(rows[0], 'outlined: ' + ' and '.join(advice.landmarks))
        elif advice.view is not None:
            rows, found = [], self._near(advice.view)
        else:
            return None
        for frame, words in found:
            if (picture := self._draw(frame, rows)) is not None:
                seconds = self._detections.stamps_s[frame] - self._detections.stamps_s[0]
                return Picture(picture, f'{words}; image at {seconds:.0f} s')
        return None

    def _showing(self, row: int, words: str) -> Iterator[tuple[int, str]]:
        """Yield the frames that show a landmark: whole, large, in a box of it first."""
        worths = []
        for frame in self._detections.every(max(1, len(self._detections) // _MOST_FRAMES)):
            outline = self._outlines(frame, [row])
            if not np.isfinite(outline).all():
                continue
            camera, box = self._detections.camera_of(frame), ellipse_bboxes(outline)
            bounds = np.array([0.0, 0.0, camera.width, camera.height])
            inside = np.clip(box, 0.0, np.tile(bounds[2:], 2))
            area, seen = (float(np.prod(one[0, 2:] - one[0, :2])) for one in (box, inside))
            worth = seen / area * min(1.0, seen / (_LARGE * camera.width * camera.height))
            if any(box_iou(box[0], one, bounds) > _OWN_IOU for one in self._boxes(frame)):
                worth += 1.0
            if seen > 0.0:
                worths.append((-worth, int(frame)))
        yield from ((frame, words) for _, frame in sorted(worths))

    def _near(self, view: Trial) -> Iterator[tuple[int, str]]:
        """Yield the frames near to a view, the nearest first, and how far they are off."""
        poses = self._detections.map_from_camera
        far_m = np.linalg.norm(poses[:, :3, 3] - view.position, axis=1)
        off_deg = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ view.forward, -1.0, 1.0)))
        different = far_m + off_deg / _DEGREES_PER_M
        for frame in np.argsort(different):
            if different[frame] < _MOST_DIFFERENT:
                yield int(frame), 'this view' if different[frame] < _SAME else (
                    f'a view {far_m[frame]:.1f} m and {off_deg[frame]:.0f} degrees off')

    def _boxes(self, frame: int) -> NDArray[np.float64]:
        return self._detections.bboxes_xyxy[slice(
            *self._detections.frame_offsets[frame:frame + 2])]

    def _outlines(self, frame: int, rows: list[int]) -> NDArray[np.float64]:
        """Return the outlines (n, 5) of landmarks in a frame [px]; NaN behind the camera."""
        return ellipses_in_pixels(project_ellipsoids(
            invert_transform(self._detections.map_from_camera[frame]), self._map.centers[rows],
            self._map.shapes[rows]), self._detections.camera_of(frame))

    def _draw(self, frame: int, rows: list[int]) -> bytes | None:
        """Return a JPEG with the boxes of a frame, and with outlines; None without its image."""
        camera = self._detections.camera_of(frame)
        image = self._read(float(self._detections.stamps_s[frame]),
                           self._detections.name_of(frame), camera)
        if image is None:
            return None
        outlines = self._outlines(frame, rows)
        corner, size = np.zeros(2), np.array([camera.width, camera.height], dtype=np.float64)
        if rows:
            # a part of the image, in which a small landmark is to be seen
            left, top, right, bottom = ellipse_bboxes(outlines[:1])[0]
            part = float(np.clip(_AROUND * max(right - left, bottom - top) / size[1], 0.3, 1.0))
            corner = np.clip(np.array([left + right, top + bottom]) / 2 - part * size / 2, 0.0,
                             (1.0 - part) * size).round()
            size = part * size
        scale = _WIDTH_PX / size[0]
        (x, y), (width, height) = corner.astype(int).tolist(), size.astype(int).tolist()
        small = cv2.resize(np.ascontiguousarray(image[y:y + height, x:x + width]), None, fx=scale,
                           fy=scale, interpolation=cv2.INTER_AREA)
        for box in (self._boxes(frame) - np.tile(corner, 2)) * scale:
            left, top, right, bottom = np.rint(box).astype(int).tolist()
            cv2.rectangle(small, (left, top), (right, bottom), _BOX_RGB, 1, cv2.LINE_AA)
        for outline in outlines:
            if np.isfinite(outline).all():
                points = np.rint((outline_points(outline) - corner) * scale).clip(-9999, 9999)
                cv2.polylines(small, [points.astype(np.int32)], True, _OUTLINE_RGB, 4, cv2.LINE_AA)
        return cv2.imencode('.jpg', small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                            )[1].tobytes()


PAGE, DATA = 'check.html', 'check.json'
LOOK_ALIKE = '#CC79A7'
VERDICT_COLORS = {'accepted': html.ACCEPTED, 'refused': html.REFUSED, 'misled': html.MISLED}
GRADE_COLORS = {'faulty': html.MISLED, 'minor': html.REFUSED, 'sound': '#009E73'}
GRADE_NAMES = {'faulty': 'serious fault', 'minor': 'minor fault', 'sound': 'sound'}
_MOST_LANDMARKS = 300
_MOST_MATCHED = 12
# Of the first screen.
_NUMBERS, FIRST_ADVICE = 3, 3
# How the names of figures for large type begin, the most telling first.
_TELLING = ('recorded frames accepted by', 'positions with a heading accepted',
            'views that mislead a robot', 'landmarks with a serious fault')


def grade(landmark: LandmarkCheck) -> str:
    """Return 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


def write_report(folder: Path, name: str, report: CheckReport,
                 pictures: Iterable[tuple[str, str, bytes]], views: ViewPainter | None = None
                 ) -> None:
    """Write the page and the JSON file of a check of a named map, each in one step.

    Pictures have a name, a caption and a PNG each; the first one is on the first screen. Views are
    beside the advice. OptionsError: a file cannot be written; the old one stays.
    """
    data = _finite({'map': name, **report.as_dict()})
    write_text(folder / DATA, json.dumps(data, indent=1, allow_nan=False))
    write_text(folder / PAGE, _page(name, report, pictures, views))


def _finite(value: Any) -> Any:
    """Return a tree with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _page(name: str, report: CheckReport, pictures: Iterable[tuple[str, str, bytes]],
          views: ViewPainter | None) -> str:
    missed = len(report.failures)
    said = html.verdict('The map reaches all thresholds.' if report.passed else
                        f'The map misses {missed} of {len(report.measures)} thresholds.',
                        report.passed)
    told = [one for name in _TELLING for one in report.measures if one.name.startswith(name)
            ][:_NUMBERS]
    first, *others = (html.figure(png, caption, picture) for picture, caption, png in pictures)
    cards = [_card(number, one, views) for number, one in enumerate(report.to_do, start=1)]
    parts = [html.first_screen(
        [said, html.tiles((one.show(one.value), one.name, not one.is_missed) for one in told),
         html.bars(_bar(one) for one in report.measures),
         '<h2>What to do first</h2>', *cards[:FIRST_ADVICE]], [first])]
    if rest := cards[FIRST_ADVICE:]:
        parts.append(html.fold(f'{len(rest)} more to do', *rest))
    faulty = sum(grade(one) == 'faulty' for one in report.landmarks)
    parts += [html.fold('All figures', html.table(('', ''), _figures(report))),
              html.fold('Pictures', *others),
              html.fold(f'Landmarks, worst first: {faulty} of {len(report.landmarks)} with a '
                        'serious fault', _landmarks(report.landmarks))]
    if report.look_alikes:
        parts.append(html.fold(f'{len(report.look_alikes)} pairs of places that look alike',
                               _look_alikes(report)))
    if report.recording is not None:
        rows = [(str(number), str(one.frames), str(one.landmarks), str(one.boxes.boxes),
                 f'{one.boxes.explained:.1%}', f'{one.boxes.median_iou:.3f}')
                for number, one in enumerate(report.recording.folds, start=1)]
        parts += [html.fold('Held-out boxes', html.note(
            'Blocks of time take turns in being judged; landmarks are fitted to the other '
            'blocks.'), html.table(('#fold', '#frames', '#landmarks', '#boxes', '#explained',
                                    '#median IoU'), rows)),
                  html.fold('Systematic residuals', _corrections(report.recording))]
    return html.page(f'Check of {name}', *parts,
                     html.fold('What these figures rest on', html.items(report.notes)))


def _card(number: int, advice: Advice, views: ViewPainter | None) -> str:
    view = None if views is None else views.of(advice)
    text = f'{number}. {advice.text}'
    return html.card(text) if view is None else html.card(text, view.jpeg, view.caption)


def _bar(one: Measure) -> html.Bar:
    """Return the bar of a figure; a count's bar has room for its limit and one more."""
    scale = max(one.limit + 1.0, one.value) if one.unit == 'count' else 1.0
    word = 'at most' if one.is_most else 'at least'
    return html.Bar(one.name, f'{one.show(one.value)} ({word} {one.show(one.limit)})',
                    one.value / scale, one.limit / scale, not one.is_missed)


def summary_lines(report: CheckReport) -> list[str]:
    """Return the figures as lines of text, for a terminal."""
    return [f'{name}: {value}' for name, value in _figures(report)]


def _figures(report: CheckReport) -> list[tuple[str, str]]:
    faulty = sum(grade(one) == 'faulty' for one in report.landmarks)
    rows = [('landmarks', str(len(report.landmarks))),
            ('with a serious fault', f'{faulty} ({report.faulty:.0%})'),
            ('pairs of duplicates', str(report.duplicates)),
            ('pairs of places that look alike', str(len(report.look_alikes)))]
    if (one := report.recording) is not None:
        rows += [
            ('recording', f'{one.frames} frames, {one.boxes} boxes, {one.duration_s:.0f} s'),
            ('explained boxes, median IoU; map as given',
             f'{one.as_given.explained:.1%}, {one.as_given.median_iou:.3f} (too good if the map '
             'was built from this recording)'),
            ('explained boxes, median IoU; held out',
             f'{one.held_out.explained:.1%}, {one.held_out.median_iou:.3f}'),
            (f'recorded frames, cross-validated, {report.evidence}', _verdicts(one.judged) + (
                '' if len(one.judged) == len(one.trials) else
                f'; of all {_verdicts(one.trials)}: no other part of the recording shows the '
                'objects of the rest')),
            *([('of these by objects alone', str(count_by_objects(one.judged)['accepted']))]
              if any(trial.by_objects for trial in one.trials) else []),
            ('the same poses with simulated boxes', _verdicts(one.simulated)),
            ('noise of box edges', f'{one.edge_scale:.2f} times that assumed by build_map')]
    if report.queries:
        rows.append(('queries with recorded similarities', _verdicts(report.queries)))
    near = ' near the recording' if report.recording else ''
    rows += [('grid views, by objects alone', _verdicts(report.grid.trials)),
             (f'grid positions{near} with a heading accepted by objects alone',
              f'{report.grid.accepted_positions:.0%} of {int(report.grid.is_near.sum())}')]
    if report.accepted_positions != report.grid.accepted_positions:
        rows.append((f'these positions, {report.evidence}', f'{report.accepted_positions:.0%}'))
    if (layer := report.keyframes) is not None:
        rows.append(('keyframes', f'{layer.keyframes} with {layer.points} points'))
        if len(layer.recorded):
            rows.append(('recorded frames within reach of a keyframe',
                         f'{layer.recorded.mean():.0%} of {len(layer.recorded)}'))
        rows.append(('grid positions within reach of a keyframe',
                     f'{layer.reached_positions:.0%} of {int(layer.is_near.sum())}'))
    return rows


def _verdicts(trials: Sequence[Trial]) -> str:
    counts = count_verdicts(trials)
    accepted = share(trials, 'accepted')
    return (f'{counts["accepted"]} of {len(trials)} accepted ({accepted:.0%}), '
            f'{counts["refused"]} refused, {counts["misled"]} misled')


def _landmarks(landmarks: Sequence[LandmarkCheck]) -> str:
    head = ('landmark', 'label', 'faults', '#frames', '#seen [%]', '#baseline [°]',
            '#deviation [cm]', '#offset [cm]', '#IoU', '#thinness', 'overlaps with')
    rows: list[list[str | tuple[str, str]]] = []
    for one in landmarks[:_MOST_LANDMARKS]:
        support = '' if one.support is None else (
            str(one.support) if one.expected is None else f'{one.support} of {one.expected}')
        label = one.class_id if one.label == one.class_id else f'{one.label} ({one.class_id})'
        numbers = [(one.seen_ratio, 100.0, 0), (one.baseline_deg, 1.0, 0),
                   (one.position_sigma_m, 100.0, 1), (one.offset_m, 100.0, 1),
                   (one.median_iou, 1.0, 2), (one.thinness, 1.0, 2)]
        texts = [support, *('' if value is None else f'{value * factor:.{digits}f}'
                            for value, factor, digits in numbers)]
        faults = '; '.join(one.faults) if one.faults else GRADE_NAMES['sound']
        rows.append([
            (one.landmark_id, grade(one)), (label, 'text'), (faults, 'text'), *texts,
            ', '.join(f'{name} ({distance:.2f})' for name, distance in one.overlaps)])
    rest = len(landmarks) - _MOST_LANDMARKS
    more = html.note(f'and {rest} more in the JSON file') if rest > 0 else ''
    return html.table(head, rows) + more + html.note(
        'frames: with the landmark, of those that should show it. seen: their share. baseline: '
        'greatest angle between two views. deviation: of the centre on its worst axis. offset: '
        'from the centre to where its boxes put it. IoU: median of its boxes. thinness: least by '
        'greatest semi-axis. In brackets: the normalized distance of an overlap.')


def _look_alikes(report: CheckReport) -> str:
    rows = []
    for number, one in enumerate(report.look_alikes, start=1):
        pairs = ', '.join(f'{first} = {second}' for first, second in one.matched[:_MOST_MATCHED])
        if len(one.matched) > _MOST_MATCHED:
            pairs += f' and {len(one.matched) - _MOST_MATCHED} more'
        rows.append((str(number), f'{one.first[0]:.1f}, {one.first[1]:.1f}',
                     f'{one.second[0]:.1f}, {one.second[1]:.1f}', f'{one.turn_deg:.0f}',
                     f'{len(one.matched)} of {one.landmarks}', str(one.same_labels), pairs))
    return html.table(('#pair', 'a: x, y [m]', 'b: x, y [m]', '#turn [deg]', '#landmarks alike',
                       '#with equal labels', 'which'), rows)


def _corrections(recording: RecordingCheck) -> str:
    if not recording.corrections:
        return html.note('Too few boxes to tell.')
    rows = [(one.cause, one.name, f'{one.value:+.2f} {one.unit}',
             f'{one.deviation:.2f} {one.unit}', f'{one.effect_px:.1f}',
             f'{one.explained:.1%}', '' if not one.is_significant else (
                 'may follow from the cause that explains most' if one.follows
                 else 'significant'))
            for one in recording.corrections]
    return (html.note('The correction that fits the edges of the boxes best, each cause on its '
                      'own. A turned mount and a shifted principal point look much the same.')
            + html.table(('cause', 'what', '#correction', '#deviation', '#effect [px]',
                          '#cost that the cause explains', ''), rows))
