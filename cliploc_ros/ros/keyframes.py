# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer of keyframes in the relocalizer: used where there is one, left out where bad."""

import logging
import time
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.layer_file import layer_hash, layer_path, load_layer_of_map
from cliploc_ros.core.keyframes.localization import (
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.keyframes.recognizer import ImageRecognizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError
from cliploc_ros.ros.map_parameters import path_of
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters

logger = logging.getLogger(__name__)

#: Value of keyframes_file for the layer next to the map, if there is one.
NEXT_TO_MAP = 'auto'
# Without so much time left, the objects' answer stands: extracting features cannot be stopped.
_LEAST_S = 0.5


class Keyframes:
    """A layer, and where it is from.

    Parameters
    ----------
    file, file_hash : str
        Where the layer is from, for the diagnostics.
    """

    def __init__(self, localizer: KeyframeLocalizer, file: str = '', file_hash: str = '') -> None:
        self.file, self.file_hash = file, file_hash
        self._localizer = localizer
        self._notes: set[str] = set()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._localizer.layer)

    @property
    def layer(self) -> KeyframeLayer:
        """Return the layer."""
        return self._localizer.layer

    def recognizer(self, image_rgb: NDArray[np.uint8], camera: Camera, deadline: float,
                   times: StageTimes) -> ImageRecognizer | None:
        """Return the keyframe search of an image; None where too little time is left.

        Parameters
        ----------
        image_rgb : ndarray (h, w, 3) uint8
        deadline : float
            When the request ends (monotonic clock) [s].
        times : StageTimes
            Of this image.
        """
        if deadline - time.monotonic() < _LEAST_S:
            return None
        note = self._localizer.layer.camera_note(camera)
        if note and note not in self._notes:
            self._notes.add(note)
            logger.warning('%s', note)
        return ImageRecognizer(self._localizer, partial(query_features, image_rgb), camera,
                               deadline, times.begin)


def load_keyframes(parameters: RelocalizerParameters, landmark_map: LandmarkMap
                   ) -> Keyframes | None:
    """Return the layer that the parameters name; None without one, or where it is bad.

    A bad layer is logged with what to do, and the relocalizer goes on with the landmarks.
    """
    named, map_file = parameters.keyframes_file, parameters.map_file
    if not named or (named == NEXT_TO_MAP and not map_file):
        return None
    path = layer_path(path_of(map_file)) if named == NEXT_TO_MAP else Path(named)
    if named == NEXT_TO_MAP and not path.exists():
        return None
    try:
        layer = load_layer_of_map(path, landmark_map)
        return Keyframes(KeyframeLocalizer(layer), str(path), layer_hash(path))
    except MapError as error:
        logger.error('localizing without keyframes: %s', error)
        return None
