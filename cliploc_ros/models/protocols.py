# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Protocols and options of detectors and encoders, independent of their networks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from cliploc_ros.errors import OptionsError

if TYPE_CHECKING:  # not at run time, for a fast --help of the programs
    import numpy as np
    from numpy.typing import NDArray

    from cliploc_ros.core.observation import Detections

#: Texts that a detector looks for, each with the class that it reports.
Prompts = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class DetectorOptions:
    """The detector to load, and how to run it. The names are those of ultralytics.

    OptionsError: a value is out of range.
    """

    #: Path of an ONNX file, of a folder with one or of a ``.pt`` file; or a network that is
    #: downloaded once: OWNER/NAME[@REVISION][:FILE] of the hub, or a published ``.pt`` file.
    #: PyTorch exports a ``.pt`` file to ONNX at its first use
    model: str = 'yolov8x.pt'
    conf: float = 0.1  #: Least confidence of a detection, 0 to 1
    iou: float = 0.7  #: Above this IoU, the weaker of two boxes of a class is dropped, 0 to 1
    imgsz: int = 640  #: Longer side of the scaled image that the network gets [px]
    max_det: int = 300  #: Greatest number of detections in an image; the most confident are kept
    #: Folder for downloads, exported and compiled networks; '': the user's cache
    cache_dir: str = ''
    #: Texts that a YOLO-World or YOLOE looks for; empty: the classes stored in its file
    prompts: Prompts = ()
    #: File of the text tower for prompts: CLIP ViT-B-32 for YOLO-World, mobileclip_blt.ts for
    #: YOLOE; '': downloaded once. Any other tower must be a TorchScript file (.ts) that converts
    #: CLIP's tokens to embeddings
    text_model: str = ''

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        for name in ('conf', 'iou'):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise OptionsError(f'{name} must be 0 to 1, not {getattr(self, name)}')
        for name in ('imgsz', 'max_det'):
            if getattr(self, name) < 1:
                raise OptionsError(f'{name} must be at least 1, not {getattr(self, name)}')


@dataclass(frozen=True)
class ClipOptions:
    """The CLIP to load."""

    #: Architecture: a name of ``open_clip.list_models()``, or the path of an open_clip model
    #: config (.json), which gets the name of the file
    model: str = 'ViT-L-14'
    #: A folder with ONNX files, or OWNER/NAME[@REVISION] of the hub; both need no model. Otherwise
    #: a tag of ``open_clip.list_pretrained()``, or the path of a checkpoint, which PyTorch exports
    #: to ONNX at its first use. A tag also determines activation and colour normalization; a
    #: checkpoint has those of the architecture.
    pretrained: str = 'openai'
    #: Local file with the weights of the tag; '': download them
    checkpoint_path: str = ''
    #: Folder for downloads, label embeddings, exported and compiled networks; '': the user's cache
    cache_dir: str = ''


class ImageTextEncoder(Protocol):
    """Embeds image crops and text labels in a common space, with cosine similarity."""

    key: str  #: Identifies model and weights: equal keys give equal embeddings

    def encode_crops(self, image_rgb: 'NDArray[np.uint8]', bboxes_xyxy: 'NDArray[np.float64]'
                     ) -> 'NDArray[np.float32]':
        """Return the embeddings (n, d) of n boxes in an image (h, w, 3) uint8, RGB.

        The boxes (n, 4) are left, top, right, bottom [px]; each must overlap the image. The
        embeddings have unit length.
        """

    def encode_labels(self, labels: Sequence[str]) -> 'NDArray[np.float32]':
        """Return the embeddings (L, d) of L labels, float32 rows of unit length."""


class ObjectDetector(Protocol):
    """Finds the objects in an image."""

    class_names: tuple[str, ...]  #: All classes of the network

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for the model."""

    def detect(self, image_rgb: 'NDArray[np.uint8]') -> 'Detections':
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Boxes are in pixels of that image. ImageError: the image has another shape or type, or no
        pixels.
        """
