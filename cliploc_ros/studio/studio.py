# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The actions of a person in the studio, without the page.

Every action returns a line that says what it did, or raises a CliplocError.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.occupancy_grid import OccupancyGrid
from cliploc_ros.mapping.check.landmark_faults import LandmarkCheck
from cliploc_ros.mapping.check.relocalization import sample_frames
from cliploc_ros.studio import edits
from cliploc_ros.studio.document import Document
from cliploc_ros.studio.edits import EditError
from cliploc_ros.studio.images import (
    Images,
    Outline,
    Pixel,
    box_at,
    draw,
    landmark_at,
    outlines_of,
)
from cliploc_ros.studio.landmark import Landmark
from cliploc_ros.studio.phrases import FoundPhrases, PhraseFinder, Question
from cliploc_ros.studio.recording import LEAST_BOXES, MIN_BOX_PX, Answer, Recording, fit_boxes
from cliploc_ros.studio.viewpoint import Extent, extent_of

Rgb = tuple[int, int, int]
# Views of the whole recording in which the relocalizer is tried.
_MAX_TRIALS = 100
# Distinct on grey and on photographs; yellow and magenta are the selection's and drawn boxes'.
_PALETTE: tuple[Rgb, ...] = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75),
    (0, 190, 190), (255, 110, 130), (120, 190, 32), (70, 90, 255), (0, 105, 92), (128, 0, 40),
    (190, 140, 255), (90, 70, 0), (120, 200, 255), (20, 40, 110), (255, 170, 120), (0, 220, 130),
    (110, 110, 110), (180, 70, 0))


class Row(NamedTuple):
    """A line of the table of landmarks."""

    landmark_id: str
    text: str
    severity: float


class Studio:
    """The document and its surroundings.

    ``recording`` has views with boxes and poses, ``images`` the images of these views, ``layer``
    the keyframes next to the map, ``grid`` its walls, to be shown.
    """

    def __init__(self, document: Document, recording: Recording | None = None,
                 images: Images | None = None, finder: PhraseFinder | None = None,
                 layer: KeyframeLayer | None = None, grid: OccupancyGrid | None = None):
        self.document = document
        self.grid = grid
        self.layer = layer
        self.finder = finder
        self.recording = recording
        self.view = 0
        self.drawn: dict[int, tuple[float, float, float, float]] = {}
        self.accepted: set[str] = set()
        self.images = images
        self._checks: dict[str, LandmarkCheck] = {}
        # the row of the table that was selected last by walking through it
        self._row = 0
        #: The relocalizer's answers that are shown; an edit leaves them as they are.
        self.answers: tuple[Answer, ...] = ()
        # of the last run over the whole recording, by verdict
        self._counts: dict[str, int] = {}
        self._colors: dict[str, Rgb] = {}
        for class_id in sorted({one.class_id for one in document.landmarks.values()}):
            self.color_of(class_id)
        if recording is not None and recording.detections.encoder_key:
            document.take_encoder(recording.detections.encoder_key)

    def extent(self) -> Extent:
        """Return where the map is, by its landmarks and by the cameras that saw it."""
        poses = (self.recording.detections.map_from_camera if self.recording is not None
                 else self.layer.map_from_camera if self.layer is not None
                 else np.empty((0, 4, 4)))
        return extent_of(np.reshape([one.center for one in self.document.landmarks.values()],
                                    (-1, 3)), poses)

    # ---- views ----------------------------------------------------------------------------------

    @property
    def views(self) -> int:
        """The number of views."""
        return 0 if self.recording is None else len(self.recording.detections)

    @property
    def map_from_camera(self) -> NDArray[np.float64]:
        """The pose (4, 4) of the selected view."""
        pose: NDArray[np.float64] = self._recording().detections.map_from_camera[self.view]
        return pose

    @property
    def camera(self) -> Camera:
        """The camera of the selected view."""
        return self._recording().detections.camera_of(self.view)

    @property
    def camera_name(self) -> str:
        """Its name; '' where the recording has one camera without a name."""
        return '' if self.recording is None else self.recording.detections.name_of(self.view)

    def show_view(self, view: int) -> None:
        """Select a view; a number beyond the last one selects the last one."""
        self.view = max(0, min(int(view), self.views - 1))

    def best_view(self) -> str:
        """Select the view that shows the selected landmark largest, wholly in the image."""
        landmark_id, landmark = self._one_selected()
        views = self._recording().best_views(landmark)
        if not views:
            raise EditError(f'{landmark_id}: no view shows all of it')
        self.view = views[0][0]
        of = f' of {self.camera_name}' if self.camera_name else ''
        return f'view {self.view}{of} shows {landmark_id} largest'

    def boxes_in_view(self) -> NDArray[np.float64]:
        """Return the detector's boxes (n, 4) in the selected view [px]."""
        detections = self._recording().detections
        first, last = detections.frame_offsets[self.view:self.view + 2]
        return detections.bboxes_xyxy[first:last]

    def outlines(self) -> list[Outline]:
        """Return the landmarks' outlines in the selected view, the nearest first."""
        return outlines_of(self.document.landmarks, self.camera, self.map_from_camera)

    def picture(self) -> NDArray[np.uint8]:
        """Return the selected view with boxes and outlines (h, w, 3), red first."""
        detections = self._recording().detections
        image = None
        if self.images is not None:
            image = self.images.near(float(detections.stamps_s[self.view]), self.camera_name,
                                      self.camera)
        colors = {key: self.color_of(one.class_id)
                  for key, one in self.document.landmarks.items()}
        return draw(self.camera, image, self.boxes_in_view(), self.drawn.get(self.view),
                    self.outlines(), colors, self.document.selection)

    def color_of(self, class_id: str) -> Rgb:
        """Return the colour of a class; the first twenty classes of a map differ."""
        return self._colors.setdefault(class_id, _PALETTE[len(self._colors) % len(_PALETTE)])

    def _recording(self) -> Recording:
        if self.recording is None:
            raise EditError('there are no views: start the studio with --observations, or with '
                            '--images and a TUM folder that has poses')
        return self.recording

    # ---- selection ------------------------------------------------------------------------------

    def select_at(self, pixel: Pixel) -> str:
        """Select the landmark whose outline in the view is around a pixel."""
        found = landmark_at(self.outlines(), pixel)
        self.document.select([] if found is None else [found])
        return f'selected {found}' if found else 'nothing there'

    def toggle(self, landmark_id: str) -> None:
        """Add a landmark to the selection, or take it out."""
        selection = self.document.selection
        self.document.select([key for key in selection if key != landmark_id]
                             if landmark_id in selection else [*selection, landmark_id])

    def _selected(self) -> tuple[str, ...]:
        if not self.document.selection:
            raise EditError('select a landmark first')
        return self.document.selection

    def _one_selected(self) -> tuple[str, Landmark]:
        if self.document.selected is None:
            raise EditError('select exactly one landmark first')
        return self.document.selected

    def undo(self) -> None:
        """Undo the last edit, if there is one."""
        self.document.undo()

    def redo(self) -> None:
        """Do again what was undone last, if anything was."""
        self.document.redo()

    # ---- edits of the selection -----------------------------------------------------------------

    def delete(self) -> str:
        """Delete the selection."""
        ids = self._selected()
        self.document.apply(edits.delete(self.document.landmarks, ids))
        return f'deleted {", ".join(ids)}'

    def toggle_lock(self) -> str:
        """Lock the selection; unlock it if all of it is locked."""
        ids, landmarks = self._selected(), self.document.landmarks
        are_locked = all(landmarks[key].is_locked for key in ids)
        self.document.apply((edits.unlock if are_locked else edits.lock)(landmarks, ids))
        return f'{"unlocked" if are_locked else "locked"} {", ".join(ids)}'

    def split(self) -> str:
        """Split the selected landmark along its longest axis, and select both halves."""
        landmark_id, _ = self._one_selected()
        change = edits.split(self.document.landmarks, landmark_id)
        self.document.apply(change)
        self.document.select(change.after)
        return f'split {landmark_id} into {" and ".join(change.after)}'

    def merge(self) -> str:
        """Merge the selection; its boxes decide the shape, or else the volumes."""
        ids, landmarks = self._selected(), self.document.landmarks
        change = edits.merge(landmarks, ids)
        how = 'by volume'
        if self.recording is not None:
            merged = change.after[ids[0]]
            assert merged is not None
            fit = self.recording.fit_together(landmarks, ids, merged.center, merged.basis)
            if fit is not None:
                change, how = edits.merge(landmarks, ids, (fit.center, fit.basis)), 'by boxes'
        self.document.apply(change)
        self.document.select([ids[0]])
        return f'merged {", ".join(ids)} {how}'

    def refit(self) -> str:
        """Fit the selection to its boxes."""
        return self._refit(self._selected())

    def refit_all(self) -> str:
        """Fit all unlocked landmarks to their boxes."""
        return self._refit([key for key, one in self.document.landmarks.items()
                            if not one.is_locked])

    def _refit(self, landmark_ids: Sequence[str]) -> str:
        landmarks = self.document.landmarks
        if locked := [key for key in landmark_ids if landmarks[key].is_locked]:
            raise EditError(f"landmark '{locked[0]}' is locked: unlock it first")
        refit = self._recording().refit(landmarks, landmark_ids)
        reasons = {key: reason for key, reason in zip(landmarks, refit.reasons, strict=True)
                   if reason is not None}
        fitted = [key for key in landmark_ids if key not in reasons]
        self.document.apply(edits.take_fits(landmarks, fitted, refit.landmark_map))
        left_out = ''.join(f'; {key} {reason}' for key, reason in list(reasons.items())[:3])
        return f'refitted {len(fitted)} of {len(landmark_ids)} landmarks{left_out}'

    # ---- a landmark from boxes ------------------------------------------------------------------

    def draw_box(self, corner: Pixel, other: Pixel) -> str:
        """Draw a box in the selected view between two opposite corners (2,) [px]."""
        size = np.array([self.camera.width, self.camera.height], dtype=np.float64)
        low, high = (np.clip(select(np.asarray(corner), np.asarray(other)), 0.0, size)
                     for select in (np.minimum, np.maximum))
        if (high - low).min() < MIN_BOX_PX:
            raise EditError(f'the box is smaller than {MIN_BOX_PX:g} pixels; drag from corner to '
                            'corner')
        self.drawn[self.view] = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        return f'{len(self.drawn)} boxes drawn'

    def take_box(self, pixel: Pixel) -> str:
        """Take the detector's smallest box around a pixel (2,) as a drawn one."""
        boxes = self.boxes_in_view()
        row = box_at(boxes, pixel)
        if row is None:
            raise EditError('no box of the detector there; drag to draw one')
        left, top, right, bottom = (float(value) for value in boxes[row])
        self.drawn[self.view] = (left, top, right, bottom)
        return f'{len(self.drawn)} boxes drawn'

    def clear_boxes(self) -> str:
        """Forget all drawn boxes."""
        self.drawn.clear()
        return 'no boxes drawn'

    def create(self, label: str, class_id: str) -> str:
        """Create a landmark from the drawn boxes, and select it."""
        recording, landmarks = self._recording(), self.document.landmarks
        detections = recording.detections
        views = sorted(self.drawn)
        fit, warning = fit_boxes([detections.camera_of(view) for view in views],
                                 detections.map_from_camera[views],
                                 np.array([self.drawn[view] for view in views]))
        change = edits.create(landmarks, label, class_id, fit.center, fit.basis)
        (landmark_id,) = change.after
        rows = recording.boxes_of(change.apply(landmarks))[landmark_id]
        look = recording.look_of(rows, self.document.encoder_key)
        self.document.apply(edits.create(landmarks, label, class_id, fit.center, fit.basis, look))
        self.document.select([landmark_id])
        self.drawn.clear()
        hint = (f'{len(rows)} boxes of the recording show it: Refit fits it to them'
                if len(rows) >= LEAST_BOXES else '')
        return '; '.join(filter(None, [f'created {landmark_id}', warning, hint]))

    # ---- the table ------------------------------------------------------------------------------

    def check(self) -> str:
        """Judge all landmarks by the recording; the table then has the worst first."""
        found = self._recording().check(self.document.landmarks)
        self._checks = {one.landmark_id: one for one in found}
        self._row = 0
        serious = sum(one.severity >= 1.0 for one in found)
        return f'checked {len(found)} landmarks: {serious} with a serious fault'

    def faults(self, landmark_id: str) -> tuple[str, ...]:
        """Return the faults of a landmark that the last check found."""
        return self._checks[landmark_id].faults if landmark_id in self._checks else ()

    def rows(self, search: str = '') -> list[Row]:
        """Return the table of landmarks whose id, label or class has a text, the worst first."""
        wanted = search.casefold().split()
        rows = []
        for key, one in self.document.landmarks.items():
            text = f'{key} · {one.label} · {one.class_id}'
            if not wanted or all(word in text.casefold() for word in wanted):
                is_open = key in self._checks and key not in self.accepted
                severity = self._checks[key].severity if is_open else 0.0
                rows.append(Row(key, ('🔒 ' if one.is_locked else '') + text, severity))
        return sorted(rows, key=lambda row: -row.severity)

    def accept(self) -> str:
        """Accept the selection as it is, whatever the check says, and go on."""
        ids = self._selected()
        following = self._following()  # acceptance changes the order of the table
        self.accepted.update(ids)
        return f'accepted {", ".join(ids)}; {self._select_row(following)}'

    def select_next(self) -> str:
        """Select the next landmark of the table; after a deletion, the one that moved up."""
        return self._select_row(self._following())

    def _following(self) -> str:
        ids, selection = [row.landmark_id for row in self.rows()], self.document.selection
        if not ids:
            raise EditError('there are no landmarks')
        return ids[(ids.index(selection[0]) + 1 if selection else self._row) % len(ids)]

    def _select_row(self, landmark_id: str) -> str:
        self.document.select([landmark_id])
        self._row = [row.landmark_id for row in self.rows()].index(landmark_id)
        return f'selected {landmark_id}'

    # ---- the relocalizer ------------------------------------------------------------------------

    def relocalize_here(self) -> str:
        """Relocalize in the selected view."""
        self.answers = tuple(self._recording().relocalize(self.document.landmarks, [self.view]))
        return self.answers[0].text(self.document.to_map())

    def relocalize_all(self) -> str:
        """Relocalize in views along the trajectory, and compare with the time before."""
        recording = self._recording()
        views = sample_frames(recording.detections, _MAX_TRIALS).tolist()
        self.answers = tuple(recording.relocalize(self.document.landmarks, views))
        before = self._counts
        self._counts = {verdict: sum(one.verdict == verdict for one in self.answers)
                        for verdict in ('accepted', 'refused', 'wrong')}
        counts = ', '.join(f'{count} {verdict}' + (f' (was {before[verdict]})' if before else '')
                           for verdict, count in self._counts.items())
        return f'{len(views)} views: {counts}; similarities are simulated'

    def phrases(self) -> tuple[str, ...]:
        """Return up to five phrases for the selected landmark: CLIP's, or else the map's."""
        if self.document.selected is None:
            return ()
        _, one = self.document.selected
        if found := self._ask_clip().phrases:
            return found
        own = sorted(one.details.labels or (), key=lambda pair: -pair[1])
        alike = [other.label for other in self.document.landmarks.values()
                 if other.class_id == one.class_id and other.label != one.label]
        return tuple(dict.fromkeys([text for text, _ in own] + alike))[:5]

    @property
    def phrase_note(self) -> str:
        """A line about CLIP's phrases for the person who edits; '' for none."""
        return self._ask_clip().note

    def _ask_clip(self) -> FoundPhrases:
        if self.finder is None or self.document.selected is None:
            return FoundPhrases((), '')
        return self.finder.answer(Question(self.document.selected[0], self.document.landmarks))
