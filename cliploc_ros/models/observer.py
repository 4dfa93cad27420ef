# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make an observation of an image and its detections: compare crops with labels."""

import time

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.index.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.models.crop_memory import CropMemory
from cliploc_ros.models.protocols import ImageTextEncoder

# A busy moment must not rule out CLIP for good: a time for which no crop fitted fades. A guess.
_FADING = 0.9
# The next batch may take this much longer than the newest one. A guess.
_SLOWER = 1.3
# The most crops between two looks at the clock.
_MOST_CROPS = 64


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
        self._memory = CropMemory()
        self._crop_s: float | None = None

    def with_labels(self, label_embeddings: LabelEmbeddings) -> 'Observer':
        """Return an observer with the same encoder for the labels of another map."""
        observer = Observer(self._encoder, label_embeddings)
        observer._memory, observer._crop_s = self._memory, self._crop_s
        return observer

    def measure(self) -> None:
        """Encode one crop, so that the first request knows how long a crop takes."""
        self._encode(np.zeros((32, 32, 3), dtype=np.uint8), np.array([[0.0, 0.0, 32.0, 32.0]]))

    def crops_within(self, left_s: float) -> int:
        """Return how many crops there is time for [s], from the time of the newest batch."""
        if self._crop_s is None:
            return 1
        count = int(np.clip(left_s / max(_SLOWER * self._crop_s, 1e-6), 0, _MOST_CROPS))
        if count < 1:
            self._crop_s *= _FADING
        return max(0, count)

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

    def crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
              ) -> 'ObservedCrops':
        """Return the crops of an image (h, w, 3) uint8 at boxes (n, 4) [px].

        Those that have not changed since an earlier image are encoded already.
        """
        return ObservedCrops(self, image_rgb, bboxes_xyxy,
                             self._memory.recall(image_rgb, bboxes_xyxy))

    def encode(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
               ) -> NDArray[np.float32]:
        """Return the embeddings (n, d) of crops, one at least, and remember them."""
        embeddings = self._encode(image_rgb, bboxes_xyxy)
        self._memory.keep(image_rgb, bboxes_xyxy, embeddings)
        return embeddings

    def _encode(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                ) -> NDArray[np.float32]:
        start = time.monotonic()
        embeddings = self._encoder.encode_crops(image_rgb, bboxes_xyxy)
        self._crop_s = (time.monotonic() - start) / len(bboxes_xyxy)
        return embeddings

    def similarities(self, embeddings: NDArray[np.float32]) -> CropSimilarities:
        """Return the similarities of crops, given their embeddings (n, d), and the labels."""
        return CropSimilarities(embeddings.reshape(-1, self._labels.shape[1]), self._labels)


class ObservedCrops:
    """The crops of one image, each encoded once at most, when it is compared.

    Parameters
    ----------
    observer : Observer
    image_rgb : ndarray (h, w, 3) uint8
    bboxes_xyxy : ndarray (n, 4)
        [px]
    known : dict of int to ndarray (d,)
        Embeddings of crops, by their row.
    """

    def __init__(self, observer: Observer, image_rgb: NDArray[np.uint8],
                 bboxes_xyxy: NDArray[np.float64], known: dict[int, NDArray[np.float32]]
                 ) -> None:
        self._observer = observer
        self._image_rgb = image_rgb
        self._bboxes_xyxy = bboxes_xyxy
        self._known = dict(known)

    @property
    def known(self) -> NDArray[np.int64]:
        """Return the rows (m,) of the crops that are encoded."""
        return np.array(sorted(self._known), dtype=np.int64)

    def compare(self, rows: NDArray[np.int64]) -> CropSimilarities:
        """Return the similarities (m, L) of some crops (m,) and the labels."""
        new = np.array([row for row in rows.tolist() if row not in self._known], dtype=np.int64)
        if len(new):
            self._known.update(zip(new.tolist(), self._observer.encode(
                self._image_rgb, self._bboxes_xyxy[new]), strict=True))
        return self._observer.similarities(
            np.array([self._known[row] for row in rows.tolist()], dtype=np.float32))
