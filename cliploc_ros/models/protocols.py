# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a detector and an encoder have to do, whatever network is inside."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from cliploc_ros.errors import OptionsError
from cliploc_ros.models.devices import check_run

if TYPE_CHECKING:  # --help of the programs shows these options, and is fast
    import numpy as np
    from numpy.typing import NDArray

    from cliploc_ros.core.observation import Detections

#: Texts that a detector looks for, and the class that it reports for each.
Prompts = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class DetectorOptions:
    """Which detector to load, and how to run it. The names are ultralytics' own.

    OptionsError: for values out of range.
    """

    #: Path of an ONNX file, of a folder with one or of a ``.pt`` file; or what is downloaded once:
    #: OWNER/NAME[@REVISION][:FILE] of the hub, or a published ``.pt`` file
    model: str = 'yolov8x.pt'
    conf: float = 0.1  #: Least confidence of a detection, 0 to 1
    iou: float = 0.7  #: IoU from which the weaker of two boxes of a class is dropped, 0 to 1
    imgsz: int = 640  #: The network sees the image with its longer side scaled to this [px]
    max_det: int = 300  #: Greatest number of detections in an image; the most confident are kept
    device: str = 'auto'  #: 'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'
    precision: str = 'auto'  #: 'auto' (fp16 on a GPU, fp32 on a CPU), 'fp16' or 'fp32'
    cache_dir: str = ''  #: Folder for downloads and compiled networks; '' is the user's cache
    #: 'auto' (OpenVINO on a CPU where it is installed), 'pytorch' or 'openvino'
    inference: str = 'auto'
    #: What a YOLO-World or YOLOE looks for; empty: the classes that it was saved with
    prompts: Prompts = ()
    #: File of its text tower: CLIP ViT-B-32 for YOLO-World, mobileclip_blt.ts for YOLOE; '' is
    #: downloaded once. Any other tower ends on .ts: TorchScript from CLIP's tokens to embeddings
    text_model: str = ''

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_run(self.precision, self.inference)
        for name in ('conf', 'iou'):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise OptionsError(f'{name} must be 0 to 1, not {getattr(self, name)}')
        for name in ('imgsz', 'max_det'):
            if getattr(self, name) < 1:
                raise OptionsError(f'{name} must be at least 1, not {getattr(self, name)}')


class ImageTextEncoder(Protocol):
    """Embeds image crops and text labels in one space, where cosine means similarity."""

    key: str  #: Identifies model and weights: equal keys give equal embeddings

    def encode_crops(self, image_rgb: 'NDArray[np.uint8]', bboxes_xyxy: 'NDArray[np.float64]'
                     ) -> 'NDArray[np.float32]':
        """Return one embedding for each box of an image (h, w, 3) uint8, red first.

        The boxes (n, 4) are left, top, right, bottom [px]; each must overlap the image. The
        embeddings (n, d) have unit length.
        """

    def encode_labels(self, labels: Sequence[str]) -> 'NDArray[np.float32]':
        """Return one embedding (L, d) for each of L labels, float32 rows of unit length."""


class ObjectDetector(Protocol):
    """Finds the objects in an image."""

    device: str  #: Where the network runs
    inference: str  #: What runs it, such as 'pytorch'
    class_names: tuple[str, ...]  #: All classes that it knows

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for model, device and inference."""

    def detect(self, image_rgb: 'NDArray[np.uint8]') -> 'Detections':
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Boxes are in pixels of that image. ImageError: it has another shape or type, or no pixels.
        """
