# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make an observation of an image and its detections: compare crops with labels."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.index.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.models.protocols import ImageTextEncoder


class Observer:
    """Encodes the crops of an image and compares them with labels.

    Parameters
    ----------
    encoder : ImageTextEncoder
    label_embeddings : LabelEmbeddings or ndarray (L, d)
        Unit rows, one for each landmark of the map.
    """

    def __init__(self, encoder: ImageTextEncoder,
                 label_embeddings: LabelEmbeddings | NDArray[np.float32]) -> None:
        self._encoder = encoder
        self._labels = LabelEmbeddings.of(label_embeddings)

    def with_labels(self, label_embeddings: LabelEmbeddings) -> 'Observer':
        """Return an observer with the same encoder for the labels of another map."""
        return Observer(self._encoder, label_embeddings)

    def observe(self, image_rgb: NDArray[np.uint8], camera: Camera, detections: Detections,
                stamp_ns: int) -> Observation:
        """Return an observation: each detection with its similarity to every label.

        Parameters
        ----------
        image_rgb : ndarray (h, w, 3) uint8
        camera : Camera
        detections : Detections
            See `Detections.usable`.
        stamp_ns : int
            Stamp of the image [ns].
        """
        crops = self._encoder.encode_crops(image_rgb, detections.bboxes_xyxy)
        return Observation(camera, detections, CropSimilarities(crops, self._labels), stamp_ns)
