# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check the detections of a camera: their classes, scores and boxes."""

from collections import Counter, deque
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

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
# Number of boxes of a frame that are kept.
_MOST_BOXES = 1000
# Kinds of refusals that a faulty detector explains.
_ITS_KINDS = (RefusalKind.TOO_FEW_OBJECTS, RefusalKind.UNEXPLAINED)
_TURN = '; turn the camera'


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
        self._frames: deque[tuple[Detections, Detections]] = deque(maxlen=frames)

    def add(self, given: Detections, usable: Detections) -> None:
        """Add the detections of a frame, and the usable ones among them."""
        # frames are kept, and a message may have 100,000 boxes
        self._frames.append((given.select(np.arange(min(len(given), _MOST_BOXES))), usable))

    @property
    def faults(self) -> list[Fault]:
        """Return the faults of the detections of the last frames."""
        scores = _scores(self._frames)
        found = self._certain(self._frames) if len(scores) >= _LEAST else []
        odd = scores[np.isfinite(scores) & ((scores < 0.0) | (scores > 1.0))]
        if len(odd):
            found.append(Fault(f'its scores are not from 0 to 1, such as {odd[0]:g}', False))
        return found

    def explain(self, found: Relocalization) -> Relocalization:
        """Add the fault of the detections, if there is one, to the refusal of the last frame.

        It replaces the advice to turn the camera, which does not help then.
        """
        last = [*self._frames][-1:]
        certain = self._certain(last)
        if found.accepted or not certain or (
                found.recognition is not None and found.recognition.outside_m is not None):
            return found
        is_cause = found.refusal_kind in _ITS_KINDS and (
            len(_scores(last)) >= _LEAST or bool(self._certain(self._frames)))
        return replace(
            found, reason=f'{found.reason.partition(_TURN)[0]}; the detector: {certain[0].text}',
            refusal_kind=RefusalKind.WRONG_DETECTIONS if is_cause else found.refusal_kind)

    def _certain(self, frames: Collection[tuple[Detections, Detections]]) -> list[Fault]:
        """Return the fault that makes all detections unusable, in a list; empty without one."""
        text, scores = '', _scores(frames)
        names = [name for name, _ in Counter(
            name for _, usable in frames for name in usable.class_ids).most_common()]
        if len(scores) and not np.isfinite(scores).any():
            text = f'none of its {len(scores)} scores is a number'
        elif len(scores) and not names:
            left, top, right, bottom = next(
                box for given, _ in frames for box in given.bboxes_xyxy[np.isfinite(given.scores)])
            text = (f'none of its {len(scores)} boxes lies in the image and is a pixel wide, such '
                    f'as {right - left:.3g} x {bottom - top:.3g} px at ({left:.3g}, {top:.3g}): '
                    'publish pixels of the image')
        elif names and self._by_class and not self._known.keys() & {*names}:
            numbers = ', which are numbers' if all(name.isdigit() for name in names) else ''
            hint = next(filter(None, (did_you_mean(name, self._known)
                                      for name in names[:_MOST_NAMES])), '')
            text = (f'none of its classes is in the map: {in_words(names)}{numbers}{hint}; the '
                    f'map has {in_words(self._known)}: use the detector of the map, or class_map')
        return [Fault(text, True)] if text else []


def _scores(frames: Iterable[tuple[Detections, Detections]]) -> NDArray[np.float64]:
    """Return the scores of all detections of some frames."""
    return np.concatenate([np.empty(0), *(given.scores for given, _ in frames)])


def in_words(names: Iterable[str]) -> str:
    """List names in one line, shortened and printable, as their source is not trusted."""
    shown = [*islice(names, _MOST_NAMES + 1)]
    cut = [''.join(char if char.isprintable() else ' ' for char in name[:_MOST_CHARACTERS])
           or 'no name' for name in shown[:_MOST_NAMES]]
    return ', '.join(cut) + (' ...' if len(shown) > _MOST_NAMES else '')
