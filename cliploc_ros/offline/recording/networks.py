# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run detector and CLIP on one frame, for an observation file."""

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import depths_of_boxes
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions, ImageTextEncoder
from cliploc_ros.offline.datasets.frames import RawFrame
from cliploc_ros.offline.datasets.observations import camera_from_numbers
from cliploc_ros.offline.mapping.views import at_border

#: Greatest number of detections per image, as in the relocalizer node.
MAX_DETECTIONS = 50


@dataclass(frozen=True)
class SeenFrame:
    """Results of detector and CLIP for a frame: n boxes."""

    #: Index of the image in its source, name of its camera ('' if there is one), and stamp [ns]
    place: int
    camera: str
    stamp_ns: int
    map_from_camera: NDArray[np.float64]  #: (4, 4)
    #: (6,): width, height, fx, fy, cx, cy of the undistorted image [px]
    camera_numbers: NDArray[np.float64]
    bboxes_in_image: NDArray[np.float64]  #: (n, 4): in the image as it is, distorted [px]
    bboxes_xyxy: NDArray[np.float64]  #: (n, 4): undistorted [px]
    open_edges: NDArray[np.bool_]  #: (n, 4): see PosedDetections
    is_distorted: bool  #: Whether open edges cannot be computed from the undistorted boxes
    #: (n,)
    class_ids: NDArray[np.str_]
    scores: NDArray[np.float64]
    embeddings: NDArray[np.float16]  #: (n, d): of the crops; d is 0 without CLIP
    #: (n,): [m]; NaN where unknown
    depths: NDArray[np.float32]
    depth_spreads: NDArray[np.float32]

    @property
    def pinhole(self) -> Camera:
        """Return the camera of the undistorted image."""
        return camera_from_numbers(self.camera_numbers[:2], self.camera_numbers[2:])

    def to_bytes(self) -> bytes:
        """Serialize the frame, without pickle."""
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in vars(self).items()}
        np.savez(buffer, **arrays)
        return buffer.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> 'SeenFrame':
        """Deserialize a frame."""
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return SeenFrame(**{name: array.item() if array.ndim == 0 else array
                                for name, array in arrays.items()})


def load_networks(detector: DetectorOptions, clip: ClipOptions | None, threads: int = 0
                  ) -> Callable[[RawFrame], SeenFrame | str]:
    """Load the networks; return the function that runs them on a frame.

    ModelError or OptionsError: the networks cannot be loaded.

    Parameters
    ----------
    clip : ClipOptions or None
        None: classes and boxes only.
    threads : int
        Threads of a network; 0: the default of the network.
    """
    if threads:
        os.environ['OMP_NUM_THREADS'] = str(threads)  # see OnnxNetwork
    encoder = None if clip is None else ClipEncoder(resolve_clip_weights(clip), clip)
    return partial(run_networks, load_detector(detector).detect, encoder)


def run_networks(detect: Callable[[NDArray[np.uint8]], Detections],
                 encoder: ImageTextEncoder | None, raw: RawFrame) -> SeenFrame | str:
    """Run a detector and an encoder on a frame that has a pose.

    If the image or depth image cannot be used, return the reason. `detect` is
    ObjectDetector.detect, or another function that returns the objects in an image.
    """
    try:
        frame = raw.decode()
    except DatasetError as error:
        return str(error)
    camera = frame.camera
    assert frame.map_from_camera is not None
    detections = detect(frame.image_rgb).usable(camera.width, camera.height, MAX_DETECTIONS)
    bboxes, size = detections.bboxes_xyxy, [camera.width, camera.height]
    open_edges = at_border(bboxes, np.array(size * 2))
    if not camera.is_pinhole:
        bboxes = camera.bboxes_in_pixels(camera.normalize_bboxes(bboxes))
    rows = np.nonzero((bboxes[:, 2:] > bboxes[:, :2]).all(axis=1))[0]  # False for NaN
    sound = detections.select(rows)
    embeddings = (np.empty((len(rows), 0)) if encoder is None
                  else encoder.encode_crops(frame.image_rgb, sound.bboxes_xyxy))
    depths = spreads = np.full(len(rows), np.nan, dtype=np.float32)
    if frame.depth is not None:
        depths, spreads = depths_of_boxes(frame.depth, camera, sound.bboxes_xyxy)
    return SeenFrame(
        raw.place, raw.camera, raw.stamp_ns, frame.map_from_camera,
        np.array([*size, camera.fx, camera.fy, camera.cx, camera.cy]), sound.bboxes_xyxy,
        bboxes[rows], open_edges[rows], not camera.is_pinhole,
        np.array(sound.class_ids, dtype=np.str_), sound.scores,
        embeddings.astype(np.float16), depths, spreads)
