# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A YOLO network as an object detector, run by PyTorch or by OpenVINO."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.files.storage import read_file
from cliploc_ros.models.devices import (
    import_openvino,
    needs_pytorch,
    resolve_device,
    resolve_inference,
    resolve_precision,
)
from cliploc_ros.models.files import fingerprint_file, first_line
from cliploc_ros.models.images import check_image_rgb
from cliploc_ros.models.open_vocabulary import set_prompts
from cliploc_ros.models.openvino_networks import (
    ABOUT,
    Conversion,
    ConversionError,
    Network,
    convert_module,
    load_network,
    open_stored,
    release_pages,
)
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_boxes import Letterbox, select_boxes, without_doubles
from cliploc_ros.models.yolo_weights import (
    import_ultralytics,
    is_export,
    load_yolo,
    resolve_yolo_weights,
    stride_of,
)

# Of an export, in metadata.yaml, with their types.
_FIELDS = {'names': dict, 'stride': int, 'task': str}
logger = logging.getLogger(__name__)


class OpenVinoYolo:
    """A detection network in OpenVINO, with ultralytics' steps before and after it.

    The network's field ``about`` holds names (by their number), stride, end2end and size: the
    height and width of its input, None where that varies.
    """

    inference = 'openvino'

    def __init__(self, network: Network) -> None:
        about = network.about
        self._network = network
        self._size = about['size']
        self._is_end2end = bool(about['end2end'])
        self.stride = int(about['stride'])
        self.names = {int(number): str(name) for number, name in about['names'].items()}

    def find(self, image_bgr: NDArray[np.uint8], conf: float, iou: float, max_det: int,
             imgsz: int) -> NDArray[np.float32]:
        """Return the boxes (n, 6) in an image: left, top, right, bottom, score, class."""
        height, width = self._size or (imgsz, imgsz)
        letterbox = Letterbox.of(image_bgr.shape[1::-1], height, width,
                                 None if self._size else self.stride)
        pixels = letterbox.fill(image_bgr)[..., ::-1].transpose(2, 0, 1)[None]
        inputs = np.ascontiguousarray(pixels, dtype=np.float32) / np.float32(255)
        rows = select_boxes(self._network(inputs)[0], conf, iou, max_det, self._is_end2end)
        return np.hstack([letterbox.in_image(rows[:, :4]), rows[:, 4:]])


def open_export(folder: Path, options: DetectorOptions) -> OpenVinoYolo:
    """Return the network of a folder of the cache, or of ``yolo export format=openvino``.

    ModelError: files are missing or damaged, or the network is for another task.
    """
    if (folder / ABOUT).exists():
        try:
            return OpenVinoYolo(open_stored(folder))
        except Exception as error:  # OpenVINO has no exceptions of its own
            raise ModelError(f'{folder} holds no sound detection network: {first_line(error)}'
                             ) from error
    about = _read_metadata(folder / 'metadata.yaml')
    file = sorted(folder.glob('*.xml'))[0]
    try:
        network = import_openvino().Core().read_model(file)
        # Without a fixed size, int8 kernels crash on some CPUs (openvino issue 37577).
        if any(node.get_type_name() == 'FakeQuantize' for node in network.get_ops()):
            network.reshape([1, 3, options.imgsz, options.imgsz])
        shape = network.input().partial_shape
        size = None if shape.is_dynamic else [shape[2].get_length(), shape[3].get_length()]
        compiled = Network(network, about | {'size': size})
        found = compiled(np.zeros((1, 3, *(size or [2 * about['stride']] * 2)), dtype=np.float32))
    except Exception as error:  # OpenVINO has no exceptions of its own
        raise ModelError(f'{file} cannot be run by OpenVINO: {first_line(error)}; export the '
                         'network again') from error
    wanted = 4 + len(about['names'])
    if found.ndim != 3 or (found.shape[1] != wanted and found.shape[2] != 6):
        raise ModelError(f'{file} is no detection network of {len(about["names"])} classes: its '
                         f'output has the shape {found.shape}')
    release_pages(file.with_suffix('.bin'))
    return OpenVinoYolo(compiled)


def _read_metadata(file: Path) -> dict[str, Any]:
    try:
        read = yaml.safe_load(read_file(file, 2**20))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ModelError(f'{file} cannot be read: {first_line(error)}; export the network again'
                         ) from error
    for name, kind in _FIELDS.items():
        value = read.get(name) if isinstance(read, dict) else None
        if not isinstance(value, kind) or not value:
            raise ModelError(f"{file}: the field '{name}' is missing or no {kind.__name__}: "
                             'export the network again')
    if read['task'] != 'detect':
        raise ModelError(f"{file.parent} is a YOLO model for the task '{read['task']}': one for "
                         "'detect' is needed")
    if sorted(read['names']) != list(range(len(read['names']))) or not 1 <= read['stride'] <= 256:
        raise ModelError(f"{file}: the field 'names' must have the keys 0, 1 ... and 'stride' "
                         'must be 1 to 256: export the network again')
    return {name: read[name] for name in ('names', 'stride')} | {
        'end2end': bool(read.get('end2end'))}


def load_converted(file: Path, options: DetectorOptions) -> OpenVinoYolo:
    """Return the network of a ``.pt`` file, converted once.

    ConversionError: OpenVINO cannot run it as PyTorch does. ModelError: the file is damaged or no
    detection model, or has to be converted where PyTorch is missing.
    """
    with needs_pytorch(f'{file}, which is not converted for OpenVINO,'):
        return OpenVinoYolo(load_network(options.cache_dir, 'YOLO', identity_of(file, options),
                                         lambda: convert_yolo(file, options), beside=file))


def identity_of(file: Path, options: DetectorOptions) -> list[str]:
    """Return what a converted network depends on: the weights and the texts that it looks for."""
    identity = [fingerprint_file(file)]
    if options.prompts:
        tower = Path(options.text_model).expanduser()
        identity += [fingerprint_file(tower) if tower.is_file() else options.text_model,
                     json.dumps(options.prompts)]
    return identity


def convert_yolo(file: Path, options: DetectorOptions) -> Conversion:
    """Return the network of a ``.pt`` file for OpenVINO; errors as of load_converted."""
    import torch

    loaded = _load_for(options, file)
    if isinstance(loaded, import_ultralytics().YOLOE):
        raise ConversionError('YOLOE is not converted for OpenVINO')
    model = loaded.model.float().eval().fuse(verbose=False)
    stride = stride_of(model)
    for module in model.modules():
        if hasattr(module, 'export'):  # the head: it then has one output, for images of any size
            module.export, module.dynamic, module.format = True, True, 'openvino'
    probe = np.random.default_rng(0).random((1, 3, 2 * stride, 3 * stride), dtype=np.float32)
    with torch.inference_mode():
        outputs = model(torch.from_numpy(probe))
        expected = outputs[0] if isinstance(outputs, tuple | list) else outputs
    network = convert_module(model, torch.zeros(1, 3, 4 * stride, 4 * stride), (1, 3, -1, -1))
    about = {'names': {int(number): str(name) for number, name in loaded.names.items()},
             'stride': stride, 'size': None, 'end2end': bool(getattr(model, 'end2end', False))}
    return Conversion(network, probe, expected.numpy(), about)


def _load_for(options: DetectorOptions, file: Path) -> Any:
    """Return ultralytics' model of a file, with the prompts of the options."""
    loaded = load_yolo(file, is_download=Path(options.model).expanduser().absolute() != file)
    if options.prompts:
        set_prompts(loaded, options)
    return loaded


class TorchYolo:
    """A detection network in PyTorch, of a ``.pt`` file; the precision is 'fp16' or 'fp32'."""

    inference = 'pytorch'

    def __init__(self, file: Path, device: str, precision: str,
                 options: DetectorOptions) -> None:
        import torch

        threads = torch.get_num_threads()
        self._model = _load_for(options, file)
        self._settings = {'device': device, 'verbose': False}
        if precision == 'fp16':
            from ultralytics.utils import DEFAULT_CFG_DICT

            # The name changed within 8.4, and the old one warns with every image.
            has_new_name = 'quantize' in DEFAULT_CFG_DICT
            self._settings |= {'quantize': 16} if has_new_name else {'half': True}
        self.stride = stride_of(self._model.model)
        self.names: dict[int, str] = self._model.names
        # The first pass sets up the predictor. It leaves one core free on a CPU, for the process.
        self.find(np.zeros((self.stride, self.stride, 3), dtype=np.uint8), imgsz=self.stride)
        torch.set_num_threads(threads)

    def find(self, image_bgr: NDArray[np.uint8], **settings: float) -> NDArray[np.float32]:
        """Return the boxes (n, 6) in an image, see OpenVinoYolo.find."""
        found = self._model.predict(image_bgr, **settings, **self._settings)[0].boxes
        return np.asarray(found.data.cpu().numpy())


class YoloDetector:
    """An `ObjectDetector`: a detection network of ultralytics.

    ModelError: when the weights are missing or damaged, or are no detection model. OptionsError:
    when the device or the inference engine is missing.
    """

    def __init__(self, options: DetectorOptions) -> None:
        self.device = resolve_device(options.device)
        self._network = _load(options, self.device)
        self.inference = self._network.inference  #: 'pytorch' or 'openvino'
        classes = dict(options.prompts)
        self._class_of = {number: classes.get(name, name)
                          for number, name in self._network.names.items()}
        #: All classes that the model knows
        self.class_names = tuple(dict.fromkeys(self._class_of.values()))
        self.configure(options)
        # The first pass sets up kernels and memory: do it before the first image.
        side = self._network.stride
        self.detect(np.zeros((side, side, 3), dtype=np.uint8))

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for model, device and inference."""
        stride = self._network.stride
        self._settings: dict[str, Any] = {
            'conf': options.conf, 'iou': options.iou, 'max_det': options.max_det,
            'imgsz': -(-options.imgsz // stride) * stride}

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        ImageError: for an image of another shape or type, or without pixels.
        """
        check_image_rgb(image_rgb)
        rows = self._network.find(np.ascontiguousarray(image_rgb[..., ::-1]), **self._settings)
        if len(self.class_names) < len(self._class_of):
            # of another text of the same class
            classes = [self.class_names.index(self._class_of[int(index)]) for index in rows[:, 5]]
            rows = rows[without_doubles(rows[:, :4], np.array(classes, dtype=np.int64),
                                        self._settings['iou'], len(rows))]
        return Detections(
            bboxes_xyxy=rows[:, :4].astype(np.float64),
            class_ids=tuple(self._class_of[int(index)] for index in rows[:, 5]),
            scores=rows[:, 4].astype(np.float64))


def _load(options: DetectorOptions, device: str) -> TorchYolo | OpenVinoYolo:
    """Load the network for the inference engine that the options choose.

    With 'auto', PyTorch runs a network that OpenVINO cannot run as PyTorch does.
    """
    path = resolve_yolo_weights(options)
    precision = resolve_precision(options.precision, device)
    inference = resolve_inference(options.inference, device, precision)
    if is_export(path):
        if options.prompts:
            raise OptionsError(f'{path}: the classes of an export are fixed: a vocabulary needs '
                               'the .pt file')
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
    with needs_pytorch(f'{path}, which OpenVINO does not run,'):
        return TorchYolo(path, device, precision, options)
