# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check the detections of a camera: their classes, scores and boxes."""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.camera_faults import Fault
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.errors import did_you_mean

# Number of frames that are kept, and minimum number of detections for a verdict. Both are guesses.
_MOST_FRAMES, _LEAST = 20, 3
# Maximum number of names in a message, and of their characters.
_MOST_NAMES, _MOST_CHARACTERS = 5, 30
# Kinds of refusals that a faulty detector explains.
_ITS_KINDS = (RefusalKind.TOO_FEW_OBJECTS, RefusalKind.UNEXPLAINED)
_TURN = '; turn the camera'


class _Tally(NamedTuple):
    """Numbers of detections in one frame or several."""

    given: int = 0  #: All detections
    scored: int = 0  #: Detections with a finite score
    usable: int = 0  #: Detections that are fit for localization
    of_map: int = 0  #: Usable detections of a class of the map
    odd_score: float | None = None  #: Example of a score that is not from 0 to 1
    bad_box: str = ''  #: Example of a box that is not usable
    classes: Counter[str] = Counter()  # noqa: RUF012 (never changed)


class DetectorCheck:
    """Count the usable and unusable detections of the last frames.

    Parameters
    ----------
    by_class : bool
        Whether classes are matched, so that the detector must use the classes of the map.
    frames : int, optional
        Number of last frames that are kept; None keeps all frames.
    """

    def __init__(self, landmark_map: LandmarkMap, by_class: bool,
                 frames: int | None = _MOST_FRAMES) -> None:
        self._known = landmark_map.classes.numbers
        # a map without landmarks, of keyframes alone, needs no classes
        self._by_class = by_class and len(landmark_map) > 0
        self._frames: deque[_Tally] = deque(maxlen=frames)

    def add(self, given: Detections, usable: Detections) -> None:
        """Add the detections of a frame, and the usable ones among them."""
        scores, boxes = given.scores, given.bboxes_xyxy
        scored = np.isfinite(scores)
        odd = scores[scored & ((scores < 0.0) | (scores > 1.0))]
        unused = ''
        if scored.any() and not len(usable):
            left, top, right, bottom = boxes[scored][0]
            unused = f'{right - left:.3g} x {bottom - top:.3g} px at ({left:.3g}, {top:.3g})'
        self._frames.append(_Tally(
            len(given), int(scored.sum()), len(usable),
            sum(class_id in self._known for class_id in usable.class_ids),
            float(odd[0]) if len(odd) else None, unused, Counter(usable.class_ids)))

    @property
    def faults(self) -> list[Fault]:
        """Return the faults of the detections of the last frames."""
        pooled = self._pooled
        found = self._certain(pooled) if pooled.given >= _LEAST else []
        if pooled.odd_score is not None:
            found.append(Fault(f'its scores are not from 0 to 1, such as {pooled.odd_score:g}',
                               False))
        return found

    def explain(self, found: Relocalization) -> Relocalization:
        """Add the fault of the detections, if there is one, to the refusal of the last frame.

        It replaces the advice to turn the camera, which does not help then.
        """
        last = self._frames[-1] if self._frames else _Tally()
        certain = self._certain(last)
        if found.accepted or not certain:
            return found
        is_cause = found.refusal_kind in _ITS_KINDS and (
            last.given >= _LEAST or bool(self._certain(self._pooled)))
        return replace(
            found, reason=f'{found.reason.partition(_TURN)[0]}; the detector: {certain[0].text}',
            refusal_kind=RefusalKind.WRONG_DETECTIONS if is_cause else found.refusal_kind)

    @property
    def _pooled(self) -> _Tally:
        """Return the numbers of all frames together."""
        frames = self._frames
        return _Tally(
            sum(frame.given for frame in frames), sum(frame.scored for frame in frames),
            sum(frame.usable for frame in frames), sum(frame.of_map for frame in frames),
            next((frame.odd_score for frame in frames if frame.odd_score is not None), None),
            next((frame.bad_box for frame in frames if frame.bad_box), ''),
            sum((frame.classes for frame in frames), Counter()))

    def _certain(self, tally: _Tally) -> list[Fault]:
        """Return the fault that makes all detections unusable, in a list; empty without one."""
        text = ''
        if tally.given and not tally.scored:
            text = f'none of its {tally.given} scores is a number'
        elif tally.given and not tally.usable:
            text = (f'none of its {tally.given} boxes lies in the image and is at least a pixel '
                    f'wide, for example {tally.bad_box}: publish pixels of the image')
        elif tally.usable and self._by_class and not tally.of_map:
            names = [name for name, _ in tally.classes.most_common()]
            numbers = ', which are numbers' if all(name.isdigit() for name in names) else ''
            hint = next(filter(None, (did_you_mean(name, self._known)
                                      for name in names[:_MOST_NAMES])), '')
            text = (f'none of its classes is in the map: {_in_words(names)}{numbers}{hint}; the '
                    f'map has {_in_words(self._known)}: use the detector of the map, or class_map')
        return [Fault(text, True)] if text else []


def _in_words(names: Iterable[str]) -> str:
    """List names in one line, shortened and printable, as their source is not trusted."""
    shown = [*islice(names, _MOST_NAMES + 1)]
    cut = [''.join(char if char.isprintable() else ' ' for char in name[:_MOST_CHARACTERS])
           or 'no name' for name in shown[:_MOST_NAMES]]
    return ', '.join(cut) + (' ...' if len(shown) > _MOST_NAMES else '')
