# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The actions of the studio, independent of the page.

Every action returns a line with its result, or raises a CliplocError.
"""

import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.answer_line import answer_line, detail_of
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.mapping.check import findings
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.relocalization import Trial, count_verdicts, sample_frames
from cliploc_ros.offline.mapping.check.report import SERIOUS
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.sightings import Sighting
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError, Landmark, Landmarks, map_of
from cliploc_ros.offline.studio.new_landmark import NewLandmark
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.room import Walls

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveRelocalizer

Rgb = tuple[int, int, int]
#: Answer to actions that need views.
NO_VIEWS = ('there are no views: start the studio with --images DIR, a folder with poses; a bag '
            'needs --observations, too')
# Greatest number of views of a recording in which the relocalizer is tried.
_MAX_TRIALS = 100
# Distinct on grey and on photographs. Yellow is used for the selection, magenta for drawn boxes.
_PALETTE: tuple[Rgb, ...] = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75),
    (0, 190, 190), (255, 110, 130), (120, 190, 32), (70, 90, 255), (0, 105, 92), (128, 0, 40),
    (190, 140, 255), (90, 70, 0), (120, 200, 255), (20, 40, 110), (255, 170, 120), (0, 220, 130),
    (110, 110, 110), (180, 70, 0))
_MAX_PHRASES = 5
# Past verb of the edit of each field; '': of a text.
_VERBS = {'label': '', 'class_id': '', 'center': 'moved', 'by': 'moved', 'angles': 'turned',
          'semi_axes': 'resized'}


class ReviewQueue:
    """The review: the user decides on each landmark of the map once, worst landmarks first.

    The order is that of the last check, so that the list does not change under the user's cursor.
    Newer landmarks are at the end. Decisions are marks of the landmarks: undo reverts them.
    """

    ACTIONS = ('accept', 'fix', 'discard', 'step')
    SLOW_ACTIONS = ('check',)

    def __init__(self, document: Document, recording: Recording | None):
        self._document, self._recording = document, recording
        #: The last check of each landmark
        self.checks: dict[str, findings.LandmarkCheck] = {}
        self._duplicates: list[tuple[str, str]] = []
        self._order: tuple[str, ...] = ()

    # ---- state ----------------------------------------------------------------------------------

    @property
    def has_boxes(self) -> bool:
        """Return whether landmarks are checked by boxes of a recording, not by the map alone."""
        return self._recording is not None and len(self._recording.detections.classes) > 0

    @property
    def order(self) -> list[str]:
        """Ids of the last check, worst first, including deleted ones; then newer landmarks."""
        return list(dict.fromkeys([*self._order, *self._document.landmarks]))

    def decision(self, landmark_id: str) -> str:
        """Return the decision on a landmark; '' without one, or after an undone deletion."""
        landmark = self._document.landmarks.get(landmark_id)
        return 'deleted' if landmark is None else landmark.decision

    def severity(self, landmark_id: str) -> float:
        """Return the severity of the faults of a landmark; 0 after a decision on it."""
        check = self.checks.get(landmark_id)
        return 0.0 if check is None or self.decision(landmark_id) else check.severity

    def counts(self) -> dict[str, int]:
        """Return the number of landmarks in the queue, 0 before a check, and of each decision."""
        found = [self.decision(key) for key in self.order] if self._order else []
        return {'total': len(found), **{name: found.count(name)
                                        for name in ('accepted', 'fixed', 'deleted')}}

    # ---- actions --------------------------------------------------------------------------------

    def check(self) -> str:
        """Check all landmarks. After a complete review, this begins a new one."""
        self._judge()
        with self._document.lock:
            landmarks = self._document.landmarks
            begins_anew = self._order and all(self.decision(key) for key in landmarks)
            if begins_anew:
                self._document.edit(edits.mark, landmarks, 'review', decision='')
        self._order = tuple(self.checks)
        serious = sum(check.severity >= SERIOUS for check in self.checks.values())
        source = '' if self.has_boxes else ' by the map alone: there are no boxes of a recording'
        what = f'checked {len(self._order)} landmarks{source}: {serious} with a serious fault'
        # keep the selection that the user has made meanwhile
        return what if self._document.selection and not begins_anew else self._go_on('', what)

    def accept(self) -> str:
        """Accept the selection regardless of the check, and select the next landmark."""
        ids = self._document.chosen()
        return self._decide(ids, 'accepted', f'accepted {", ".join(ids)}')

    def discard(self) -> str:
        """Delete the selection, and select the next landmark."""
        ids = self._document.chosen()
        self._document.edit(edits.delete, ids)
        if self._document.landmarks and any({*pair} & {*ids} for pair in self._duplicates):
            self._judge()  # the other landmark of the pair is no longer a duplicate
        return self._go_on(ids[-1], f'deleted {", ".join(ids)}')

    def fix(self) -> str:
        """Apply the remedy of the check: merge a duplicate, fit any other landmark to its boxes.

        The landmark is checked again, and the next one is selected if no serious fault is left.
        The boxes of a moved object may still lie at its old place: look at the result.
        """
        landmark_id = self._document.chosen()[0]
        if self._recording is None or not self.has_boxes:
            raise EditError(f'{landmark_id}: there are no boxes to fit it to: edit, accept or '
                            'delete it')
        landmarks = self._document.landmarks
        pairs = [pair for pair in self._duplicates if landmark_id in pair
                 and all(key in landmarks for key in pair)]
        if pairs:  # the nearest first
            partner = pairs[0][pairs[0][0] == landmark_id]
            change, how = self._recording.merged(landmarks, [landmark_id, partner])
            what = f'merged {landmark_id} with {partner} {how}'
        else:
            change, left_out = self._recording.refitted(landmarks, [landmark_id])
            if left_out:
                raise EditError(f'{landmark_id} {left_out[landmark_id]}: edit, accept or delete '
                                'it')
            what = f'fitted {landmark_id} to its boxes'
        gesture = object()  # one undo reverts both the fix and the decision
        self._document.apply(change, gesture)
        self._judge()
        left = self.checks[landmark_id]
        if left.severity >= SERIOUS:
            self._document.select([landmark_id])
            return f'{what}; it still {left.faults[0]}'
        return self._decide([landmark_id], 'fixed', what, gesture)

    def step(self, count: int) -> None:
        """Select the landmark `count` places further in the queue."""
        if type(count) is not int:
            raise EditError(f'step: expected a whole number, not {count!r:.60}')
        ids = [key for key in self.order if key in self._document.landmarks]
        if not ids:
            raise EditError('there are no landmarks')
        selection = self._document.selection
        place = ids.index(selection[0]) + count if selection else 0
        self._document.select([ids[place % len(ids)]])

    # ---------------------------------------------------------------------------------------------

    def _decide(self, ids: Sequence[str], decision: str, what: str, gesture: object = None) -> str:
        """Store a decision, and select the next landmark without a decision."""
        self._document.edit(edits.mark, ids, decision, decision=decision, gesture=gesture)
        return self._go_on(ids[-1], what)

    def _go_on(self, last: str, what: str) -> str:
        order = self.order
        start = order.index(last) + 1 if last in order else 0
        rest = [key for key in order[start:] + order[:start] if not self.decision(key)]
        if not rest:
            return f'{what}; the review is complete'
        self._document.select(rest[:1])
        return what

    def _judge(self) -> None:
        landmarks, recording = self._document.landmarks, self._recording
        if not landmarks:
            raise EditError('there are no landmarks to review: create one first')
        landmark_map, views, witness = map_of(landmarks), None, None
        if recording is not None and self.has_boxes:
            views, witness = recording.views, recording.witness(landmark_map)
        overlaps = findings.find_map_overlaps(landmark_map, witness, views)
        found = findings.check_landmarks(landmark_map, witness, overlaps)
        ids = list(landmarks)
        self.checks = {check.landmark_id: check for check in found}
        self._duplicates = [(ids[overlap.first], ids[overlap.second]) for overlap in overlaps
                            if overlap.is_duplicate]


class Studio:
    """The document with its recording, searches and results. All users of the page share it.

    ``recording`` has views with boxes, poses and images, ``layer`` has the keyframes next to the
    map, and ``walls`` are shown in the scene.

    Attributes
    ----------
    changed : Event
        Set by any thread when the page must be redrawn.
    view : int
        The selected view.
    answers : dict of int to Trial
        The relocalizer's answers that are shown, by view. Edits do not change them.
    check_page : str
        The HTML page of the last check, '' without one.
    share : float
        Completed share of a stage of the check, 0 to 1.
    """

    ACTIONS = ('select', 'edit', 'lock', 'hide', 'delete', 'split', 'merge', 'refit', 'refit_all',
               'show_view', 'next_view', 'stop_check')
    #: Slow actions, which lock the document only while they need it.
    SLOW_ACTIONS = ('relocalize_here', 'relocalize_all', 'check_map', 'relocalize_robot',
                    'reload_robot')

    #: Options of the check, which then takes about a minute.
    CHECK = CheckOptions(max_positions=100, headings=8, frames=30)

    def __init__(self, document: Document, recording: Recording | None = None,
                 layer: KeyframeLayer | None = None, walls: Walls | None = None):
        self.document, self.recording = document, recording
        self.layer, self.walls = layer, walls
        self.live: LiveRelocalizer | None = None
        self.changed = document.changed
        self.review = ReviewQueue(document, recording)
        self.new = None if recording is None else NewLandmark(document, recording)
        self.view = 0
        self.answers: dict[int, Trial] = {}
        # counts of the last run over the whole recording, by verdict
        self._counts: dict[str, int] = {}
        self.check_page, self.share = '', 0.0
        self._checked: Landmarks = {}
        self._stopped = threading.Event()
        self._searcher = ThreadPoolExecutor(1)
        # the last search of sightings: id and fields of its landmark; the last result
        self._search: Future[None] | None = None
        self._wanted: tuple[str, str] = '', ''
        self._sightings: tuple[str, list[Sighting]] = '', []
        self._colors: dict[str, Rgb] = {}
        for class_id in sorted({landmark.class_id for landmark in document.landmarks.values()}):
            self.color_of(class_id)
        if recording is not None and recording.detections.encoder_key:
            document.take_encoder(recording.detections.encoder_key)

    def stop(self) -> None:
        """Stop the searches."""
        self._stopped.set()
        self._searcher.shutdown(cancel_futures=True)

    # ---- views ----------------------------------------------------------------------------------

    @property
    def views(self) -> int:
        """The number of views."""
        return 0 if self.recording is None else len(self.recording.detections)

    @property
    def map_from_camera(self) -> NDArray[np.float64]:
        """The pose (4, 4) of the selected view."""
        return np.asarray(self.seen().detections.map_from_camera[self.view])

    @property
    def camera(self) -> Camera:
        """The camera of the selected view."""
        return self.seen().detections.camera_of(self.view)

    def seen(self) -> Recording:
        """Return the recording; EditError: there is none."""
        if self.recording is None:
            raise EditError(NO_VIEWS)
        return self.recording

    def show_view(self, view: int) -> None:
        """Select a view. A number beyond the last view selects the last view."""
        view = int(edits.numbers([view], 1, 'view')[0])
        self.view = max(0, min(view, self.views - 1))
        self.changed.set()

    def next_view(self) -> None:
        """Select the view that is best for the next box of a new landmark."""
        self.seen()
        assert self.new is not None
        self.show_view(self.new.next_view())

    def sightings(self, landmark_id: str) -> list[Sighting] | None:
        """Return the best views of a landmark; None until a thread has found any."""
        recording, landmarks = self.recording, self.document.landmarks
        wanted = landmark_id, str(landmarks[landmark_id].fields)

        def find() -> None:
            try:
                found = recording.sightings(landmarks, landmark_id) if recording else []
            except CliplocError:  # an image cannot be read; the view reports it
                found = []
            self._sightings = landmark_id, found
            self.changed.set()

        # during a drag, the views are not updated
        is_dragged = self.document.gesture is not None and self._wanted[0] == landmark_id
        if recording is not None and wanted != self._wanted and not is_dragged:
            if self._search is not None:
                self._search.cancel()  # unless it has begun
            self._wanted, self._search = wanted, self._searcher.submit(find)
        return self._sightings[1] if self._sightings[0] == landmark_id else None

    def color_of(self, class_id: str) -> Rgb:
        """Return the colour of a class. The first twenty classes of a map differ in colour."""
        return self._colors.setdefault(class_id, _PALETTE[len(self._colors) % len(_PALETTE)])

    # ---- selection and edits --------------------------------------------------------------------

    def shown(self) -> dict[str, Landmark]:
        """Return the landmarks that are not hidden."""
        return {key: landmark for key, landmark in self.document.landmarks.items()
                if not landmark.is_hidden}

    def select(self, id: str, joins: bool = False) -> None:
        """Select a landmark, or toggle it in the selection."""
        id = str(id)
        others = [key for key in self.document.selection if key != id] if joins else []
        is_chosen = joins and id in self.document.selection
        self.document.select(others if is_chosen else [*others, id])

    def edit(self, field: str, value: Any, gesture: object = None) -> str | None:
        """Set a field or the angles [deg] of the selected landmark, or move it by metres."""
        key, landmark = self.document.only_chosen()
        verb = _VERBS.get(str(field))
        if verb is None:
            raise EditError(f"a landmark has no field '{field!s:.60}'")
        value = edits.numbers(value, 3, field) if verb else str(value)
        values: dict[str, Any] = {field: value}
        if field == 'angles':
            values = {'orientation': Rotation.from_euler('xyz', value, degrees=True).as_quat()}
        elif field == 'by':
            values = {'center': (value := np.add(landmark.center, value))}
        change = self.document.edit(edits.set_fields, [key], **values,
                                    gesture=(field, key, gesture))
        if not change.after:
            return None
        return f'{key}: {change.what}' if not verb else (
            f'{verb} {key} to {" ".join(f"{number:.2f}" for number in value)} '
            f'{"deg" if field == "angles" else "m"}')

    def delete(self) -> str:
        """Delete the selection."""
        ids = self.document.chosen()
        self.document.edit(edits.delete, ids)
        return f'deleted {", ".join(ids)}'

    def lock(self, ids: Sequence[str] | None = None) -> str:
        """Lock landmarks, by default the selection; unlock them if all are locked."""
        return self._toggle(ids, 'is_locked', ('lock', 'locked'), ('unlock', 'unlocked'))

    def hide(self, ids: Sequence[str] | None = None) -> str:
        """Hide landmarks, by default the selection; show them if all are hidden."""
        return self._toggle(ids, 'is_hidden', ('hide', 'hid'), ('show', 'showed'))

    def _toggle(self, ids: Sequence[str] | None, name: str, on: tuple[str, str],
                off: tuple[str, str]) -> str:
        """Set a mark, or clear it if all landmarks have it.

        `on` and `off` are the verbs of both: in the history, and in the log.
        """
        if ids is not None and not (isinstance(ids, list)
                                    and all(isinstance(key, str) for key in ids)):
            raise EditError(f'{on[0]}: expected a list of ids, not {ids!r:.60}')
        ids, landmarks = ids or self.document.chosen(), self.document.landmarks
        have_it = all(getattr(landmarks[key], name) for key in ids if key in landmarks)
        verb, past = off if have_it else on
        self.document.edit(edits.mark, ids, verb, **{name: not have_it})
        return f'{past} {", ".join(ids)}'

    def split(self) -> str:
        """Split the selected landmark along its longest axis, and select both halves."""
        landmark_id, _ = self.document.only_chosen()
        change = self.document.edit(edits.split, landmark_id)
        self.document.select(change.after)
        return f'split {landmark_id} into {" and ".join(change.after)}'

    def merge(self) -> str:
        """Merge the selection. The shape fits its boxes, or without boxes the total volume."""
        ids, landmarks = self.document.chosen(), self.document.landmarks
        change, how = ((edits.merge(landmarks, ids), 'by volume') if self.recording is None
                       else self.recording.merged(landmarks, ids))
        self.document.apply(change)
        self.document.select([ids[0]])
        return f'merged {", ".join(ids)} {how}'

    def refit(self) -> str:
        """Fit the selection to its boxes."""
        return self._refit(self.document.chosen())

    def refit_all(self) -> str:
        """Fit all unlocked landmarks to their boxes."""
        return self._refit([key for key, landmark in self.document.landmarks.items()
                            if not landmark.is_locked])

    def _refit(self, landmark_ids: Sequence[str]) -> str:
        change, reasons = self.seen().refitted(self.document.landmarks, landmark_ids)
        self.document.apply(change)
        left_out = ''.join(f'; {key} {reason}' for key, reason in list(reasons.items())[:3])
        return (f'refitted {len(landmark_ids) - len(reasons)} of {len(landmark_ids)} landmarks'
                f'{left_out}')

    # ---- the relocalizer ------------------------------------------------------------------------

    def relocalize_here(self) -> str:
        """Relocalize in the selected view."""
        view, landmarks = self.view, self.document.landmarks
        answers = self.seen().relocalize(landmarks, [view], self.layer)
        self.answers = answers
        trial, result = answers[view], answers[view].result
        assert result is not None
        return '; '.join(filter(None, [
            f'view {view + 1}: ' + answer_line(trial.verdict, detail_of(
                result, self.document.file.frame_id), result.refusal_kind),
            '' if trial.error_m is None else f'off by {trial.error_m:.2f} m',
            'similarities are simulated']))

    def relocalize_all(self) -> str:
        """Relocalize in views along the trajectory, and compare with the previous run."""
        views = sample_frames(self.seen().detections, _MAX_TRIALS).tolist()
        answers = self.seen().relocalize(self.document.landmarks, views, self.layer)
        self.answers = answers
        before, self._counts = self._counts, count_verdicts(list(answers.values()))
        counts = ', '.join(f'{count} {verdict}' + (f' (was {before[verdict]})' if before else '')
                           for verdict, count in self._counts.items())
        return f'{len(answers)} views: {counts}; similarities are simulated'

    def check_map(self) -> str:
        """Check the map as the program check_map does, at fewer positions; make its page.

        CliplocError: the map is empty, or the check was stopped; the last page is kept. After a
        stop, call ``allow_check`` before the next check.
        """
        # imported late, since matplotlib takes a second
        from cliploc_ros.offline.evaluation.check_page import check_page

        def tell(stage: str, share: float) -> None:
            if self._stopped.is_set():
                raise CliplocError('the check was stopped')
            self.share = share
            self.changed.set()

        tell('', 0.0)
        with self.document.lock:
            landmarks, landmark_map = self.document.landmarks, self.document.to_map()
        detections, image_of, images = None, None, None
        if self.recording is not None and self.review.has_boxes:
            detections, image_of = self.recording.detections, self.recording.image
            images = self.recording.images
        report = check_map(landmark_map, detections, options=replace(
            self.CHECK, is_size_given=self.recording is not None and self.recording.is_size_given,
            of_folder=images is not None and images.of_folder),
            progress=tell, layer=self.layer, image_of=None if images is None else image_of)
        self.check_page = check_page(self.document.path.name, landmark_map, report, detections,
                                     image_of)
        self._checked = landmarks
        return '; '.join(['checked the map', *report.summary])

    def stop_check(self) -> None:
        """Stop the check of the map."""
        self._stopped.set()

    def allow_check(self) -> None:
        """Allow the next check of the map; only later calls of ``stop_check`` stop it."""
        self._stopped.clear()

    @property
    def is_stale(self) -> bool:
        """Return whether the map was edited since the last check."""
        return bool(self.check_page) and self._checked != self.document.landmarks

    def relocalize_robot(self) -> str:
        """Request a relocalization from the running relocalizer."""
        return self._robot().relocalize()

    def reload_robot(self) -> str:
        """Make the running relocalizer read its map again."""
        message = self._robot().reload_map()
        return message if self.document.is_saved else f'{message}; without the unsaved edits'

    def _robot(self) -> 'LiveRelocalizer':
        if self.live is None:
            raise EditError('no relocalizer is connected: start the studio with --ros')
        return self.live

    def phrases(self, landmark_id: str) -> list[str]:
        """Return up to five labels for a landmark: its own, and those of its class in the map."""
        landmarks, landmark = self.document.landmarks, self.document.landmarks[landmark_id]
        own = sorted(landmark.details.labels or (), key=lambda pair: -pair[1])
        alike = [other.label for other in landmarks.values()
                 if other.class_id == landmark.class_id and other.label != landmark.label]
        return list(dict.fromkeys([text for text, _ in own] + alike))[:_MAX_PHRASES]
