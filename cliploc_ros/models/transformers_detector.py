# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A detector of the transformers library (Apache-2.0), such as D-FINE or RT-DETR, by PyTorch."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.devices import resolve_device, resolve_precision
from cliploc_ros.models.files import check_weights_file, download, first_line
from cliploc_ros.models.images import check_image_rgb
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_boxes import without_doubles

_WEIGHTS = 'model.safetensors'
_FILES = ('config.json', 'preprocessor_config.json', _WEIGHTS)
_HUB_NAME = re.compile(r'[\w-][\w.-]*/[\w-][\w.-]*')


def is_of_transformers(model: str) -> bool:
    """Return whether a name is that of a folder with a config.json, or OWNER/NAME of the hub."""
    path = Path(model).expanduser()
    return (path / 'config.json').is_file() or (
        not path.exists() and path.suffix not in ('.pt', '.ts')
        and _HUB_NAME.fullmatch(model) is not None)


class TransformersDetector:
    """An `ObjectDetector`: a detection network of transformers.

    The image is resized as the model's own preprocessing says, and ``imgsz`` changes nothing.
    Only weights in safetensors are read, and no code of a model is run.

    ModelError: the library or files are missing, or hold no detection network. OptionsError: the
    device is missing, or the options ask for OpenVINO or prompts.
    """

    inference = 'pytorch'

    def __init__(self, options: DetectorOptions) -> None:
        if options.prompts:
            raise OptionsError(f'{options.model}: its classes are fixed: a vocabulary needs a '
                               'YOLO-World or YOLOE')
        if options.inference == 'openvino':
            raise OptionsError(f"{options.model} runs in PyTorch only: set inference to 'auto'")
        device = resolve_device(options.device)
        os.environ.setdefault('HF_HUB_DISABLE_TELEMETRY', '1')
        try:
            import torch
            import transformers
        except ModuleNotFoundError as error:
            raise ModelError(f'{error.name} is not installed, and {options.model} needs it: pip '
                             "install the extras 'models' and 'transformers', see doc/install.md"
                             ) from error
        self.device = str(device)
        self._dtype = (torch.float16 if resolve_precision(options.precision, device) == 'fp16'
                       else torch.float32)
        folder = _resolve(options)
        transformers.utils.logging.disable_progress_bar()
        try:
            # trust_remote_code: without it the library asks on the terminal
            self._processor = transformers.AutoImageProcessor.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False)
            self._model, report = transformers.AutoModelForObjectDetection.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False, use_safetensors=True,
                output_loading_info=True)
        except Exception as error:  # transformers has no exceptions of its own
            raise ModelError(f'{folder} is no detection model of transformers: '
                             f'{first_line(error)}') from error
        if report['missing_keys']:  # the library fills them with random numbers
            raise ModelError(f'{folder / _WEIGHTS} lacks {len(report["missing_keys"])} weights, '
                             f"such as '{min(report['missing_keys'])}': download it again")
        self._model.eval().to(self.device, self._dtype)
        self._names: dict[int, str] = self._model.config.id2label
        #: All classes that the model knows
        self.class_names = tuple(dict.fromkeys(self._names.values()))
        self.configure(options)
        self.detect(np.zeros((64, 64, 3), dtype=np.uint8))  # sets up kernels before an image

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for model, device and inference."""
        self._options = options

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Several boxes of a class on one object, as weak queries give them, are one: see ``iou``.

        ImageError: for an image of another shape or type, or without pixels.
        """
        import torch

        check_image_rgb(image_rgb)
        height, width = image_rgb.shape[:2]
        inputs = self._processor(images=np.ascontiguousarray(image_rgb), return_tensors='pt',
                                 input_data_format='channels_last')
        with torch.inference_mode():
            outputs: Any = self._model(**inputs.to(self.device, self._dtype))
            found = self._processor.post_process_object_detection(
                outputs, threshold=self._options.conf, target_sizes=[(height, width)])[0]
            boxes, scores, labels = (found[name].float().cpu().numpy()
                                     for name in ('boxes', 'scores', 'labels'))
        rows = np.argsort(-scores, kind='stable')
        rows = rows[without_doubles(boxes[rows], labels[rows], self._options.iou,
                                    self._options.max_det)]
        return Detections(
            bboxes_xyxy=np.clip(boxes[rows].astype(np.float64), 0.0, [width, height] * 2),
            class_ids=tuple(self._names[int(label)] for label in labels[rows]),
            scores=scores[rows].astype(np.float64))


def _resolve(options: DetectorOptions) -> Path:
    """Return the folder of a model; download it if it is not here yet."""
    folder = Path(options.model).expanduser().absolute()
    if not folder.is_dir():
        folder = _downloaded(options)
    for name in _FILES[:2]:
        if not (folder / name).is_file():
            raise ModelError(f'{folder} has no {name}: download all of {", ".join(_FILES)}')
    check_weights_file(folder / _WEIGHTS)
    return folder


def _downloaded(options: DetectorOptions) -> Path:
    import huggingface_hub

    own = resolve_cache_dir(options.cache_dir) / 'weights'
    for cache in (own, None):
        found = [huggingface_hub.try_to_load_from_cache(options.model, name, cache)
                 for name in _FILES]
        if all(isinstance(one, str) for one in found):
            return Path(str(found[0])).parent

    def fetch() -> Path:
        # Where packets are dropped, this gives up after 10 s, and the download after 6 minutes.
        huggingface_hub.file_exists(options.model, _WEIGHTS)
        return Path(huggingface_hub.snapshot_download(options.model, cache_dir=own,
                                                      allow_patterns=list(_FILES)))

    return download(f"the detector '{options.model}'", own, (
        f'Without a network: download {", ".join(_FILES)} from https://huggingface.co/'
        f'{options.model} on another machine and set the model to the path of their folder'),
        fetch)
