# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframe search of one image, for the verdict: run when it is needed, kept for the next."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.localization import (
    NOTHING_KNOWN,
    PROPOSED,
    KeyframeLocalizer,
    keyframes_near,
)
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.search.prior import Prior


class ImageRecognizer:
    """The keyframe search of one image, which several searches of its objects ask.

    Parameters
    ----------
    features : Features or callable
        Of the image; a callable is called when they are needed first.
    begin_stage : callable
        Takes the name of a stage that begins: 'keyframes', and 'search' after them.
    """

    def __init__(self, keyframes: KeyframeLocalizer, features: Features | Callable[[], Features],
                 camera: Camera, deadline: float = np.inf,
                 begin_stage: Callable[[str], None] = lambda stage: None) -> None:
        self._keyframes = keyframes
        self._features = features
        self._camera = camera
        self._deadline = deadline
        self._begin_stage = begin_stage
        self._known: tuple[set[int], Recognition] | None = None
        #: Time that it took so far [ms].
        self.spent_ms = 0.0

    def recognize(self, guesses: Sequence[NDArray[np.float64]], prior: Prior = NOTHING_KNOWN
                  ) -> Recognition:
        """Find where the image was taken; again only where guesses propose other keyframes."""
        near = {row for guess in guesses for row in keyframes_near(
            self._keyframes.layer.map_from_camera, guess)[:PROPOSED].tolist()}
        if self._known is None or not near <= self._known[0]:
            self._begin_stage('keyframes')
            begin = time.perf_counter()
            if callable(self._features):
                self._features = self._features()
            self._known = near, self._keyframes.localize_features(
                self._features, self._camera, guesses, self._deadline, prior)
            self.spent_ms += 1e3 * (time.perf_counter() - begin)
            self._begin_stage('search')
        return self._known[1]

    @property
    def deviation_per_metre(self) -> float:
        """Return the layer's, see KeyframeLayer."""
        return self._keyframes.layer.deviation_per_metre

    def coverage(self, map_from_camera: NDArray[np.float64]) -> float:
        """Return KeyframeLocalizer.coverage for the camera of the image."""
        return self._keyframes.coverage(map_from_camera, self._camera)
