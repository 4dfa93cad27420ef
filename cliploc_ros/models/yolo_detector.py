# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A YOLO network as an object detector, run by PyTorch or by OpenVINO."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import OptionsError
from cliploc_ros.models.devices import resolve_device, resolve_inference, resolve_precision
from cliploc_ros.models.images import check_image_rgb
from cliploc_ros.models.openvino_networks import ConversionError
from cliploc_ros.models.yolo_openvino import OpenVinoYolo, load_converted, open_export
from cliploc_ros.models.yolo_weights import (
    YoloOptions,
    import_ultralytics,
    is_export,
    load_yolo,
    resolve_yolo_weights,
    stride_of,
)

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)


class TorchYolo:
    """A detection network in PyTorch, of a ``.pt`` file; the precision is 'fp16' or 'fp32'."""

    inference = 'pytorch'

    def __init__(self, file: Path, device: 'torch.device', precision: str) -> None:
        self._model = load_yolo(file)
        self._settings = {'device': str(device), 'verbose': False}
        if precision == 'fp16':
            from ultralytics.utils import DEFAULT_CFG_DICT

            # The name changed within 8.4, and the old one warns with every image.
            has_new_name = 'quantize' in DEFAULT_CFG_DICT
            self._settings |= {'quantize': 16} if has_new_name else {'half': True}
        self.stride = stride_of(self._model.model)
        self.names: dict[int, str] = self._model.names

    def find(self, image_bgr: NDArray[np.uint8], **settings: float) -> NDArray[np.float32]:
        """Return the boxes (n, 6) in an image, see OpenVinoYolo.find."""
        found = self._model.predict(image_bgr, **settings, **self._settings)[0].boxes
        return np.asarray(found.data.cpu().numpy())


class YoloDetector:
    """An `ObjectDetector`: a detection network of ultralytics.

    Raises
    ------
    ModelError
        When the weights are missing or damaged, or are no detection model.
    OptionsError
        When the device or the inference engine is missing.
    """

    def __init__(self, options: YoloOptions) -> None:
        import torch

        threads = torch.get_num_threads()
        import_ultralytics()
        device = resolve_device(options.device)
        self.device = str(device)
        self._network = _load(options, device)
        self.inference = self._network.inference  #: 'pytorch' or 'openvino'
        #: All classes that the model knows
        self.class_names = tuple(self._network.names.values())
        self.configure(options)
        # The first pass sets up the predictor: do it before the first image.
        side = self._network.stride
        self.detect(np.zeros((side, side, 3), dtype=np.uint8))
        # Ultralytics leaves one core free on a CPU, for the whole process.
        torch.set_num_threads(threads)

    def configure(self, options: YoloOptions) -> None:
        """Change the options, except for model, device and inference."""
        stride = self._network.stride
        self._settings: dict[str, Any] = {
            'conf': options.conf, 'iou': options.iou, 'max_det': options.max_det,
            'imgsz': -(-options.imgsz // stride) * stride}

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Raises
        ------
        ImageError
            For an image of another shape or type, or without pixels.
        """
        check_image_rgb(image_rgb)
        rows = self._network.find(np.ascontiguousarray(image_rgb[..., ::-1]), **self._settings)
        return Detections(
            bboxes_xyxy=rows[:, :4].astype(np.float64),
            class_ids=tuple(self._network.names[int(index)] for index in rows[:, 5]),
            scores=rows[:, 4].astype(np.float64))


def _load(options: YoloOptions, device: 'torch.device') -> TorchYolo | OpenVinoYolo:
    """Load the network for the inference engine that the options choose.

    With 'auto', PyTorch runs a network that OpenVINO cannot run as PyTorch does.
    """
    path = resolve_yolo_weights(options)
    precision = resolve_precision(options.precision, device)
    inference = resolve_inference(options.inference, device, precision)
    if is_export(path):
        if inference != 'openvino':
            raise OptionsError(f"{path} needs OpenVINO (pip install openvino), device 'cpu', "
                               "precision 'fp32' and inference 'auto' or 'openvino'")
        return open_export(path, options)
    if inference == 'openvino':
        try:
            return load_converted(path, options)
        except ConversionError as error:
            if options.inference == 'openvino':
                raise
            logger.warning('%s; PyTorch runs it (inference: pytorch saves the attempt)', error)
    return TorchYolo(path, device, precision)
