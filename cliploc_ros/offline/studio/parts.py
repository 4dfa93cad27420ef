# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The content of the page, part by part, as JSON, and its pictures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.offline import page as html
from cliploc_ros.offline.studio.desk import Desk
from cliploc_ros.offline.studio.landmark import Landmark, shape_fields
from cliploc_ros.offline.studio.studio import Studio
from cliploc_ros.offline.studio.web import Content

# Greatest number of outlines: more hide the image and delay a drag.
_MAX_OUTLINES = 200
_CROP_PX = 160
# Greatest number of answers in the list after a run over the recording.
_MAX_ANSWERS = 100


def parts_of(desk: Desk) -> dict[str, Any]:
    """Return the parts of the page by name."""
    studio, document = desk.studio, desk.studio.document
    review = studio.review
    found = {
        'file': {
            'name': document.path.name, 'frame': document.frame_id, 'is_saved': document.is_saved,
            'notes': document.notes, 'undo': document.to_undo, 'redo': document.to_redo,
            'conflict': document.has_conflict, 'views': studio.views,
            'has_boxes': review.has_boxes, 'images': studio.recording is not None
            and studio.recording.images is not None,
            'classes': sorted({landmark.class_id for landmark in document.landmarks.values()})},
        'rows': [[key, one.label, one.class_id, one.is_locked, one.is_hidden,
                  review.severity(key), one.decision,
                  '#{:02x}{:02x}{:02x}'.format(*studio.color_of(one.class_id))]
                 for key in review.order if (one := document.landmarks.get(key))],
        'selection': {'ids': document.selection, 'one': _selected_part(studio)},
        'review': {**review.counts(), 'running': list(desk.running)},
        'log': {'lines': desk.lines, 'is_old': desk.is_old},
        'layers': desk.layers,
        'test': {
            'share': round(studio.share, 2), 'running': list(desk.running),
            'is_stale': studio.is_stale, 'has_page': bool(studio.check_page),
            'answers': [[view, one.verdict, None if one.error_m is None else round(one.error_m, 2),
                         one.reason] for view, one in list(studio.answers.items())[:_MAX_ANSWERS]],
            'robot': None if studio.live is None else studio.live.lines(document)}}
    if studio.recording is not None:
        found |= _view_parts(studio)
    return found


def _selected_part(studio: Studio) -> dict[str, Any] | None:
    if studio.document.selected is None:
        return None
    key, one = studio.document.selected
    check, sightings = studio.review.check_of(key), studio.sightings(key)
    return {
        'id': key, 'label': one.label, 'class_id': one.class_id,
        'is_locked': one.is_locked, 'decision': one.decision,
        'center': one.center.tolist(), 'semi_axes': one.semi_axes.tolist(),
        'angles': [round(float(angle), 3) + 0.0 for angle in Rotation.from_quat(
            one.quat_xyzw).as_euler('xyz', degrees=True)],
        'phrases': studio.phrases(key), 'is_checked': check is not None,
        'faults': () if check is None else check.faults,
        'support': None if check is None else check.support,
        'ratio': None if check is None else check.seen_ratio,
        'sightings': sightings and [
            [one.view, *one.bbox_xyxy.round(1).tolist(), one.is_detected] for one in sightings]}


def _view_parts(studio: Studio) -> dict[str, Any]:
    """Return the parts of the selected view and of the new landmark."""
    new, recording, view = studio.new, studio.recording, studio.view
    assert recording is not None and new is not None
    selection, seen = studio.document.selection, recording.detections.detections_of(view)
    shown = [outline for number, outline in enumerate(recording.outlines(studio.shown(), view))
             if number < _MAX_OUTLINES or outline.landmark_id in selection]
    guess = {} if new.fit is None else {'': Landmark(shape_fields(new.fit.center, new.fit.basis))}
    return {
        'view': {
            'view': view, 'camera': recording.detections.name_of(view),
            'size': [studio.camera.width, studio.camera.height],
            'boxes': [[*box, name] for box, name in zip(
                seen.bboxes_xyxy.round(1).tolist(), seen.class_ids, strict=True)],
            'outlines': [[one.landmark_id, *_axes_of(one.ellipse)] for one in shown],
            'guess': [_axes_of(outline.ellipse) for outline in recording.outlines(guess, view)],
            'guide': new.guide(view).round(1).tolist()},
        'new': {'boxes': sorted(new.boxes.items()), 'class_id': new.class_id, 'doubt': new.doubt}}


def _axes_of(ellipse: NDArray[np.float64]) -> list[float]:
    """Return an outline's centre and semi-axes [px], and the angle of the first axis [deg]."""
    cx, cy, exx, exy, eyy = ellipse
    mean, apart = 0.5 * (exx + eyy), np.hypot(0.5 * (exx - eyy), exy)
    axes = np.sqrt(np.maximum([mean + apart, mean - apart], 0.0))
    return [round(float(value), 1) for value in (
        cx, cy, *axes, np.degrees(0.5 * np.arctan2(2.0 * exy, exx - eyy)))]


def picture_of(studio: Studio, path: str) -> Content | None:
    """Return an image, a crop or the last check: /image/ANY/VIEW, /crop/ANY/VIEW/X,Y,X,Y, /check.

    CliplocError: an image cannot be read.
    """
    kind, *words = path.strip('/').split('/')
    if kind == 'check' and studio.check_page:
        return Content(studio.check_page.encode(), '.html', False)
    if studio.recording is None or kind not in ('image', 'crop'):
        return None
    try:
        view = int(words[1])
        image = studio.recording.image(view) if kind == 'image' else studio.recording.crop(
            view, np.array([float(word) for word in words[2].split(',')]).reshape(4))
    except (ValueError, IndexError):
        return None
    if image is None:
        return None
    return Content(html.jpeg_of(image, _CROP_PX if kind == 'crop' else None), '.jpg', True)
