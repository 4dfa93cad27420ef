# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The review: the user decides on each landmark of the map once, worst landmarks first.

The order is that of the last check, so that the list does not change under the user's cursor.
Newer landmarks are at the end. Decisions are marks of the landmarks: undo reverts them, and they
survive a restart.
"""

from collections.abc import Sequence

from cliploc_ros.offline.mapping.check.findings import (
    LandmarkCheck,
    check_landmarks,
    find_map_overlaps,
)
from cliploc_ros.offline.mapping.check.report import SERIOUS
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError, map_of
from cliploc_ros.offline.studio.recording import Recording


class ReviewQueue:
    """The queue of landmarks, and the decisions on them."""

    ACTIONS = ('accept', 'fix', 'discard', 'step')
    SLOW_ACTIONS = ('check',)

    def __init__(self, document: Document, recording: Recording | None):
        self._document, self._recording = document, recording
        self._checks: dict[str, LandmarkCheck] = {}
        self._duplicates: list[tuple[str, str]] = []
        self._order: tuple[str, ...] = ()

    # ---- state ----------------------------------------------------------------------------------

    @property
    def has_boxes(self) -> bool:
        """Return whether landmarks are checked by boxes of a recording, not by the map alone."""
        return self._recording is not None and len(self._recording.detections.classes) > 0

    def check_of(self, landmark_id: str) -> LandmarkCheck | None:
        """Return the last check of a landmark."""
        return self._checks.get(landmark_id)

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
        check = self._checks.get(landmark_id)
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
        self._order = tuple(self._checks)
        serious = sum(check.severity >= SERIOUS for check in self._checks.values())
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
        left = self._checks[landmark_id]
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

    def _decide(self, ids: Sequence[str], decision: str, what: str, gesture: object = None
                ) -> str:
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
        overlaps = find_map_overlaps(landmark_map, witness, views)
        found = check_landmarks(landmark_map, witness, overlaps)
        ids = list(landmarks)
        self._checks = {check.landmark_id: check for check in found}
        self._duplicates = [(ids[overlap.first], ids[overlap.second]) for overlap in overlaps
                            if overlap.is_duplicate]
