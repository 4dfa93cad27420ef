# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The phrases that describe a landmark best, ranked by CLIP.

Loading CLIP takes seconds, and embedding a vocabulary for the first time up to a minute.
"""

import logging
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights, resolve_clip_weights
from cliploc_ros.offline.mapping.labelling import best_phrases, phrases_of_classes
from cliploc_ros.offline.mapping.landmarks import classes_of
from cliploc_ros.offline.studio.landmark import Landmarks, map_of
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.vocabulary.vocabulary import Vocabulary, shipped_phrases

_PHRASES = 5
# Number of views that are embedded for a landmark without embeddings.
_CROPS = 3

logger = logging.getLogger(__name__)


class FoundPhrases(NamedTuple):
    """The best phrases, best first, and a note for the user; '' without a note."""

    phrases: tuple[str, ...]
    note: str


class PhraseFinder:
    """Finds phrases for landmarks.

    Landmarks without a look get embeddings from the recording: its embeddings, or its images.
    """

    def __init__(self, clip: ClipOptions, vocabulary: Vocabulary, recording: Recording | None):
        self._clip, self._vocabulary, self._recording = clip, vocabulary, recording
        self._fault = ''

    def find(self, landmarks: Landmarks, landmark_id: str) -> FoundPhrases:
        """Return the phrases for a landmark, or why there are none.

        If the weights cannot be loaded, this is not retried: all landmarks get the same fault.
        """
        if self._fault:
            return FoundPhrases((), self._fault)
        try:
            return self._find(landmarks, landmark_id)
        except Exception as error:  # including those of torch and open_clip: the page shows them
            return FoundPhrases((), _explained(error))

    @cached_property
    def _weights(self) -> ClipWeights:
        try:
            return resolve_clip_weights(self._clip)
        except Exception as error:
            self._fault = _explained(error)
            raise

    @cached_property
    def _encoder(self) -> ClipEncoder:
        return ClipEncoder(self._weights, self._clip)

    def _find(self, landmarks: Landmarks, landmark_id: str) -> FoundPhrases:
        mean = self._mean(landmarks, landmark_id)
        if mean is None:
            return FoundPhrases((), 'CLIP offers no phrases: neither embeddings nor images show '
                                'the whole landmark')
        names = classes_of(map_of({landmark_id: landmarks[landmark_id]}), 0)
        phrases = phrases_of_classes(
            self._weights, self._clip,
            [{name: shipped_phrases(name) for name in names},
             {name: texts for name, texts in self._vocabulary.added.items() if name in names}])
        best = best_phrases(mean, [part for name in names for part in phrases[name]])
        return FoundPhrases(tuple(text for text, _ in best[:_PHRASES]), '')

    def _mean(self, landmarks: Landmarks, landmark_id: str) -> NDArray[np.float32] | None:
        """Return the mean embedding (d,) of a landmark's crops; None without crops."""
        look, recording, key = landmarks[landmark_id].look, self._recording, self._weights.key
        if (look is None or look.encoder_key != key) and recording is not None:
            look = recording.look_of(recording.boxes_of(landmarks)[landmark_id], key)
        if look is not None and look.encoder_key == key:
            return look.mean.astype(np.float32)
        if recording is None:
            return None
        sightings = recording.sightings(landmarks, landmark_id, _CROPS)
        seen = [(recording.image(sighting.view), sighting.bbox_xyxy)
                for sighting in sightings if sighting.is_whole]
        embeddings = [self._encoder.encode_crops(image, box[None])[0] for image, box in seen
                      if image is not None]
        mean = np.sum(embeddings, axis=0)
        length = float(np.linalg.norm(mean))
        return np.asarray(mean / length, dtype=np.float32) if length > 0.0 else None


def _explained(error: Exception) -> str:
    """Return why there are no phrases; log errors of other packages."""
    if isinstance(error, CliplocError):
        return f'CLIP offers no phrases: {error}'
    logger.error('CLIP finds no phrases', exc_info=error)
    return f'CLIP offers no phrases: {type(error).__name__}: {error}'
