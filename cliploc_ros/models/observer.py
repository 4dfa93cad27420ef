# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From an image and its detections to an observation: crops are compared with labels here."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.index.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.models.protocols import ImageTextEncoder


class Observer:
    """Looks at the crops of an image with an encoder.

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
        """Return what the camera saw, each detection with its similarity to every label.

        Parameters
        ----------
        image_rgb : ndarray (h, w, 3) uint8
        camera : Camera
        detections : Detections
            Usable ones, see Detections.usable.
        stamp_ns : int
            When the image was taken [ns].
        """
        crops = self._encoder.encode_crops(image_rgb, detections.bboxes_xyxy)
        return Observation(camera, detections, CropSimilarities(crops, self._labels), stamp_ns)
