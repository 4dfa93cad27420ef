# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run a YOLO of ultralytics in PyTorch, for a GPU; export it to ONNX."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.models.devices import resolve_device, resolve_precision
from cliploc_ros.models.export import OPSET, compare, halve, quiet_export
from cliploc_ros.models.exports import DETECTOR, describe_export
from cliploc_ros.models.images import check_image_rgb
from cliploc_ros.models.open_vocabulary import set_prompts
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_boxes import without_doubles
from cliploc_ros.models.yolo_weights import load_yolo, stride_of


class YoloDetector:
    """An `ObjectDetector`: a detection network of ultralytics in a ``.pt`` file.

    ModelError: the weights are damaged, or are not those of a detection model. OptionsError: the
    device is missing, or the network does not take texts.
    """

    inference = 'pytorch'

    def __init__(self, file: Path, options: DetectorOptions) -> None:
        import torch

        self.device = resolve_device(options.device)
        threads = torch.get_num_threads()
        self._model = load_yolo(
            file, is_download=Path(options.model).expanduser().absolute() != file)
        if options.prompts:
            set_prompts(self._model, options)
        self._run: dict[str, Any] = {'device': self.device, 'verbose': False}
        if resolve_precision(options.precision, self.device) == 'fp16':
            from ultralytics.utils import DEFAULT_CFG_DICT

            # The name changed within version 8.4; the old one causes a warning for each image.
            has_new_name = 'quantize' in DEFAULT_CFG_DICT
            self._run |= {'quantize': 16} if has_new_name else {'half': True}
        self._stride = stride_of(self._model.model)
        classes = dict(options.prompts)
        self._class_of: dict[int, str] = {number: classes.get(name, name)
                                          for number, name in self._model.names.items()}
        #: All classes of the model
        self.class_names = tuple(dict.fromkeys(self._class_of.values()))
        self.configure(options)
        # The first pass sets up predictor, kernels and memory; run it before the first image. On a
        # CPU, ultralytics also sets the threads of the process to leave a core free: undo that.
        self.detect(np.zeros((self._stride, self._stride, 3), dtype=np.uint8))
        torch.set_num_threads(threads)

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for model, device and inference."""
        self._settings: dict[str, Any] = {
            'conf': options.conf, 'iou': options.iou, 'max_det': options.max_det,
            'imgsz': -(-options.imgsz // self._stride) * self._stride}

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        ImageError: the image has another shape or type, or no pixels.
        """
        check_image_rgb(image_rgb)
        found = self._model.predict(np.ascontiguousarray(image_rgb[..., ::-1]), **self._settings,
                                    **self._run)[0].boxes
        rows = np.asarray(found.data.cpu().numpy())
        if len(self.class_names) < len(self._class_of):
            # several texts of a class give duplicate boxes
            classes = [self.class_names.index(self._class_of[int(index)]) for index in rows[:, 5]]
            rows = rows[without_doubles(rows[:, :4], np.array(classes, dtype=np.int64),
                                        self._settings['iou'], len(rows))]
        return Detections(
            bboxes_xyxy=rows[:, :4].astype(np.float64),
            class_ids=tuple(self._class_of[int(index)] for index in rows[:, 5]),
            scores=rows[:, 4].astype(np.float64))


def export_detector(file: Path, options: DetectorOptions, folder: Path, half: bool = False
                    ) -> None:
    """Export a YOLO of ultralytics into a folder, with the classes of the options' prompts.

    ``half``: see export_clip.

    ExportError: the results differ from those in PyTorch. ModelError: the file is damaged or not a
    detection model. OptionsError: the network does not take texts.
    """
    import torch

    loaded = load_yolo(file, is_download=Path(options.model).expanduser().absolute() != file)
    if options.prompts:
        set_prompts(loaded, options)
        classes = dict(options.prompts)
        loaded.model.names = {number: classes[name] for number, name in loaded.names.items()}
    model = loaded.model.float().eval()
    model.pt_path = str(folder / 'model.pt')
    with quiet_export():
        loaded.export(format='onnx', dynamic=True, simplify=False, opset=OPSET, verbose=False)
    if half:
        halve(folder / DETECTOR)
    stride = stride_of(model)
    probe = np.random.default_rng(0).random((1, 3, 2 * stride, 3 * stride), dtype=np.float32)
    with torch.inference_mode():
        outputs = model(torch.from_numpy(probe))
    expected = outputs[0] if isinstance(outputs, tuple | list) else outputs
    compare(folder / DETECTOR, probe, expected[0] if isinstance(expected, tuple) else expected,
             half)
    describe_export(folder, 'detector')
