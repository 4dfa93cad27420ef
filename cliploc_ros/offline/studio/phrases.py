# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Phrases that describe a landmark best, chosen by CLIP in a thread of its own.

Loading CLIP takes seconds, and reading a vocabulary for the first time up to a minute. The page
goes on meanwhile. Only the last question counts.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights, resolve_clip_weights
from cliploc_ros.offline.mapping.labelling import best_phrases
from cliploc_ros.offline.studio.images import Images
from cliploc_ros.offline.studio.landmark import Landmark
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.sightings import find_sightings
from cliploc_ros.offline.vocabulary.phrase_embeddings import phrases_of_classes
from cliploc_ros.offline.vocabulary.vocabulary import Vocabulary, shipped_phrases

_PHRASES = 5
# Views in which a landmark without embeddings is looked at.
_CROPS = 3
_MOST_KEPT = 1000

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Question:
    """Which phrases describe a landmark? The landmarks are those of the whole map."""

    landmark_id: str
    landmarks: Mapping[str, Landmark]

    @property
    def landmark(self) -> Landmark:
        """The landmark in question."""
        return self.landmarks[self.landmark_id]

    @property
    def class_names(self) -> tuple[str, ...]:
        """All classes that the landmark was detected as."""
        weights = self.landmark.details.class_weights or ()
        return tuple(dict.fromkeys([self.landmark.class_id, *(name for name, _ in weights)]))

    @property
    def key(self) -> tuple[object, ...]:
        """What the answer depends on; a drag changes none of it."""
        return self.landmark_id, self.class_names, self.landmark.look


class FoundPhrases(NamedTuple):
    """The best phrases, the best one first, and what a person should know; '' for nothing."""

    phrases: tuple[str, ...]
    note: str


_PENDING = FoundPhrases((), 'CLIP looks for phrases; the map offers its own until then')


class PhraseFinder:
    """Answers questions one at a time.

    Landmarks without a look are looked at in the recording: in its embeddings, or its images.
    """

    def __init__(self, clip: ClipOptions, vocabulary: Vocabulary, recording: Recording | None,
                 images: Images | None):
        self._clip, self._vocabulary = clip, vocabulary
        self._recording, self._images = recording, images
        self._weights: ClipWeights | None = None
        self._encoder: ClipEncoder | None = None
        self._answers: dict[tuple[object, ...], FoundPhrases] = {}
        self._fault: FoundPhrases | None = None
        self._wanted: Question | None = None
        self._lock = threading.Lock()
        self._listener: Callable[[], None] = lambda: None
        self._is_working = self._is_closed = False

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call a function after each answer."""
        self._listener = listener

    def answer(self, question: Question) -> FoundPhrases:
        """Return the answer, or that it is not known yet."""
        with self._lock:
            found = self._answers.get(question.key, self._fault)
            if found is not None:
                return found
            self._wanted = question
            if not self._is_working and not self._is_closed:
                self._is_working = True
                threading.Thread(target=self._work, daemon=True).start()
            return _PENDING

    def close(self) -> None:
        """Answer nothing more."""
        self._is_closed = True

    # ---- in the thread --------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._lock:
                question = self._wanted
                if self._is_closed or question is None or question.key in self._answers:
                    self._is_working = False
                    return
            try:
                found = self._find(question)
            except CliplocError as error:
                found = FoundPhrases((), f'CLIP offers no phrases: {error}')
            except Exception as error:  # of torch, open_clip: the page shows it and goes on
                logger.exception('CLIP finds no phrases for %s', question.landmark_id)
                found = FoundPhrases((), f'CLIP offers no phrases: {type(error).__name__}: '
                                     f'{error}')
            with self._lock:
                if len(self._answers) >= _MOST_KEPT:
                    self._answers.clear()
                self._answers[question.key] = found
                self._fault = found if self._weights is None else None
            self._listener()

    def _find(self, question: Question) -> FoundPhrases:
        if self._weights is None:
            self._weights = resolve_clip_weights(self._clip)
        mean = self._mean(question, self._weights)
        if mean is None:
            return FoundPhrases((), 'CLIP offers no phrases: neither embeddings nor images show '
                                'all of this landmark')
        names = question.class_names
        phrases = phrases_of_classes(
            self._weights, self._clip,
            [{name: shipped_phrases(name) for name in names},
             {name: texts for name, texts in self._vocabulary.added.items() if name in names}])
        best = best_phrases(mean, [part for name in names for part in phrases[name]])
        return FoundPhrases(tuple(text for text, _ in best[:_PHRASES]), '')

    def _mean(self, question: Question, weights: ClipWeights) -> NDArray[np.float32] | None:
        """Return the mean embedding (d,) of a landmark's crops; None where nothing shows it."""
        look = question.landmark.look
        if look is not None and look.encoder_key != weights.key:
            look = None
        if look is None and self._recording is not None:
            boxes = self._recording.boxes_of(question.landmarks)[question.landmark_id]
            look = self._recording.look_of(boxes, weights.key)
        if look is not None and len(look.mean) == weights.embed_dim:
            return look.mean.astype(np.float32)
        if self._recording is None or self._images is None:
            return None
        embeddings = []
        for one in find_sightings(self._recording, self._images, question.landmarks,
                                  question.landmark_id, _CROPS):
            detections = self._recording.detections
            image = self._images.near(float(detections.stamps_s[one.view]),
                                      detections.name_of(one.view), detections.camera_of(one.view))
            if image is not None and one.is_whole:
                if self._encoder is None:
                    self._encoder = ClipEncoder(weights, self._clip)
                embeddings.append(self._encoder.encode_crops(image, one.bbox_xyxy[None])[0])
        mean = np.sum(embeddings, axis=0)
        length = float(np.linalg.norm(mean))
        return np.asarray(mean / length, dtype=np.float32) if length > 0.0 else None
