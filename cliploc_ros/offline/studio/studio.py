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
from cliploc_ros.offline.mapping.check.relocalization import RecordedKeyframes, sample_frames
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.floor import OccupancyGrid
from cliploc_ros.offline.studio.images import Images, Outline, Pixel, landmark_at, outlines_of
from cliploc_ros.offline.studio.landmark import Landmark
from cliploc_ros.offline.studio.new_landmark import NewLandmark
from cliploc_ros.offline.studio.phrases import FoundPhrases, PhraseFinder, Question
from cliploc_ros.offline.studio.recording import Recording, ViewAnswer
from cliploc_ros.offline.studio.review import ReviewQueue
from cliploc_ros.offline.studio.viewpoint import Bounds, extent_of

Rgb = tuple[int, int, int]
SELECTED_RGB: Rgb = (255, 220, 0)
# Views of the whole recording in which the relocalizer is tried.
_MAX_TRIALS = 100
# Distinct on grey and on photographs; yellow and magenta are the selection's and drawn boxes'.
_PALETTE: tuple[Rgb, ...] = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75),
    (0, 190, 190), (255, 110, 130), (120, 190, 32), (70, 90, 255), (0, 105, 92), (128, 0, 40),
    (190, 140, 255), (90, 70, 0), (120, 200, 255), (20, 40, 110), (255, 170, 120), (0, 220, 130),
    (110, 110, 110), (180, 70, 0))


class Row(NamedTuple):
    """A line of the list of landmarks."""

    landmark_id: str
    label: str
    class_id: str
    is_locked: bool
    is_hidden: bool
    severity: float
    decision: str


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
        self.images = images
        self.review = ReviewQueue(document, recording)
        self.new = None if recording is None else NewLandmark(document, recording)
        self.view = 0
        #: The relocalizer's answers that are shown; an edit leaves them as they are.
        self.answers: tuple[ViewAnswer, ...] = ()
        # of the last run over the whole recording, by verdict
        self._counts: dict[str, int] = {}
        self._colors: dict[str, Rgb] = {}
        for class_id in sorted({one.class_id for one in document.landmarks.values()}):
            self.color_of(class_id)
        if recording is not None and recording.detections.encoder_key:
            document.take_encoder(recording.detections.encoder_key)

    def extent(self) -> Bounds:
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

    def outlines(self) -> list[Outline]:
        """Return the shown landmarks' outlines in the selected view, the nearest first."""
        return outlines_of(self.shown(), self.camera, self.map_from_camera)

    def image(self, view: int) -> NDArray[np.uint8] | None:
        """Return the undistorted image (h, w, 3) of a view, red first; None without one."""
        detections = self._recording().detections
        if self.images is None or not 0 <= view < self.views:
            return None
        return self.images.near(float(detections.stamps_s[view]), detections.name_of(view),
                                detections.camera_of(view))

    def color_of(self, class_id: str) -> Rgb:
        """Return the colour of a class; the first twenty classes of a map differ."""
        return self._colors.setdefault(class_id, _PALETTE[len(self._colors) % len(_PALETTE)])

    def _recording(self) -> Recording:
        if self.recording is None:
            raise EditError('there are no views: start the studio with --observations, or with '
                            '--images and a TUM folder that has poses')
        return self.recording

    # ---- selection ------------------------------------------------------------------------------

    def shown(self) -> dict[str, Landmark]:
        """Return the landmarks that are not hidden."""
        return {key: one for key, one in self.document.landmarks.items()
                if not one.marks.is_hidden}

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

    # ---- edits of the selection -----------------------------------------------------------------

    def delete(self) -> str:
        """Delete the selection."""
        ids = self._selected()
        self.document.edit(edits.delete, ids)
        return f'deleted {", ".join(ids)}'

    def toggle_lock(self, landmark_ids: Sequence[str] | None = None) -> str:
        """Lock landmarks, by default the selection; unlock them if all are locked."""
        return self._toggle(landmark_ids, 'is_locked', ('lock', 'locked'), ('unlock', 'unlocked'))

    def toggle_hidden(self, landmark_ids: Sequence[str] | None = None) -> str:
        """Hide landmarks, by default the selection; show them if all are hidden."""
        return self._toggle(landmark_ids, 'is_hidden', ('hide', 'hid'), ('show', 'showed'))

    def _toggle(self, landmark_ids: Sequence[str] | None, name: str, on: tuple[str, str],
                off: tuple[str, str]) -> str:
        """Set a mark, or clear it where all have it; a verb and its past for each."""
        ids, landmarks = landmark_ids, self.document.landmarks
        if ids is None:
            ids = self._selected()
        if not ids:
            raise EditError('name a landmark, or select one')
        have_it = all(getattr(landmarks[key].marks, name) for key in ids if key in landmarks)
        verb, past = off if have_it else on
        self.document.edit(edits.mark, ids, verb, **{name: not have_it})
        return f'{past} {", ".join(ids)}'

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
        change, how = ((edits.merge(landmarks, ids), 'by volume') if self.recording is None
                       else self.recording.merged(landmarks, ids))
        self.document.apply(change)
        self.document.select([ids[0]])
        return f'merged {", ".join(ids)} {how}'

    def refit(self) -> str:
        """Fit the selection to its boxes."""
        return self._refit(self._selected())

    def refit_all(self) -> str:
        """Fit all unlocked landmarks to their boxes."""
        return self._refit([key for key, one in self.document.landmarks.items()
                            if not one.marks.is_locked])

    def _refit(self, landmark_ids: Sequence[str]) -> str:
        change, reasons = self._recording().refitted(self.document.landmarks, landmark_ids)
        self.document.apply(change)
        left_out = ''.join(f'; {key} {reason}' for key, reason in list(reasons.items())[:3])
        return (f'refitted {len(landmark_ids) - len(reasons)} of {len(landmark_ids)} landmarks'
                f'{left_out}')

    def rows(self) -> list[Row]:
        """Return the list of landmarks, in the order of the review."""
        review, landmarks = self.review, self.document.landmarks
        return [Row(key, one.label, one.class_id, one.marks.is_locked, one.marks.is_hidden,
                    review.severity(key), one.marks.decision)
                for key in review.order if (one := landmarks.get(key))]

    # ---- the relocalizer ------------------------------------------------------------------------

    def _keyframes(self) -> RecordedKeyframes | None:
        """Return the keyframes and the images of the views; None without them."""
        return None if self.layer is None or self.images is None else RecordedKeyframes(
            self.layer, self.image)

    def relocalize_here(self) -> str:
        """Relocalize in the selected view."""
        self.answers = tuple(self._recording().relocalize(self.document.landmarks, [self.view],
                                                          self._keyframes()))
        return self.answers[0].text(self.document.to_map())

    def relocalize_all(self) -> str:
        """Relocalize in views along the trajectory, and compare with the time before."""
        recording = self._recording()
        views = sample_frames(recording.detections, _MAX_TRIALS).tolist()
        self.answers = tuple(recording.relocalize(self.document.landmarks, views,
                                                  self._keyframes()))
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
