# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors in ONNX files: exports of YOLO, and of D-FINE, RT-DETR, DETR and similar networks.

The meaning of the outputs is read from the metadata of the file and the configuration next to it.
"""

import ast
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import ModelError, OptionsError, first_line
from cliploc_ros.models.exports import DETECTOR, export_key, exported
from cliploc_ros.models.files import digest_file, find_network, is_hub_name, resolve_folder
from cliploc_ros.models.onnx_network import ANY, OnnxNetwork, colours, numbers, one_of, read_config
from cliploc_ros.models.protocols import DetectorOptions

_CONFIG, _PREPROCESSOR = 'config.json', 'preprocessor_config.json'
#: The files of a published detector; of the networks, the first that exists is used.
NETWORKS = ('model.onnx', 'onnx/model.onnx')
BESIDE = (_CONFIG, _PREPROCESSOR)
_LOGITS, _BOXES = 'logits', 'pred_boxes'
# Default stride of YOLO, for files without one, and greatest stride.
_STRIDE, _MOST_STRIDE = 32, 1024
# Fields of a size, and greatest side of an image that a network takes.
_SIDES, _MOST_PX = ('height', 'width', 'shortest_edge', 'longest_edge'), 8192
# Grey of the borders, and greatest number of boxes that are compared, as in ultralytics.
_GREY = (114, 114, 114)
_MOST_BOXES = 30_000
# Greatest length of the name of a class, as in a map.
_MOST_NAME = 1000
#: Said of grey images
GREY = ('the images are grey, but detector and CLIP are trained on colour images: classes and '
        'labels may be wrong; use a colour camera')
# Greatest mean difference between the channels of a pixel in a grey image, and least range of all
# values in an image that is not black [grey levels]. Chosen: JPEG keeps grey exactly.
_GREY_LEVELS, _BLACK_LEVELS = 0.5, 16
# Greatest number of boxes in noise of a network with the right input (chosen; measured: YOLOv8n 0,
# with pixels from 0 to 255 300).
_IN_NOISE = 3
# Columns of the output of a network that removes duplicates itself: box, score, class.
_END2END = 6


class OnnxDetector:
    """An `ObjectDetector` in an ONNX file, run by OpenVINO on a CPU.

    ModelError: a file is missing or damaged, or is not a detector; the message names it.
    OptionsError: the options have prompts.
    """

    def __init__(self, options: DetectorOptions) -> None:
        if options.prompts:
            raise OptionsError(f'{options.model} has fixed classes: a vocabulary needs the .pt '
                               'file of a YOLO-World or YOLOE')
        file = Path(options.model).expanduser().absolute()
        if is_hub_name(options.model) or file.is_dir():
            file = find_network(resolve_folder(options.model, [NETWORKS], BESIDE,
                                               options.cache_dir), options.model, NETWORKS)
        export_key(file.parent, options.cache_dir)  # warns about a changed export
        network = OnnxNetwork(file, options.cache_dir)
        self._head = (DetrHead if {_LOGITS, _BOXES} <= set(network.outputs) else YoloHead)(network)
        #: All classes of the network
        self.class_names = tuple(dict.fromkeys(self._head.names.values()))
        self.configure(options)
        # Sets up kernels before the first image, and tests whether the outputs are as expected.
        try:
            self.detect(np.zeros((64, 64, 3), dtype=np.uint8))
        except RuntimeError as error:  # OpenVINO has no exception classes
            raise ModelError(f'OpenVINO cannot run {file}: {first_line(error)}; export the '
                             'network again') from error

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for the model."""
        self._options = options

    def scores_by_input(self, images_rgb: Sequence[NDArray[np.uint8]]) -> dict[str, float]:
        """Return the sums of scores in images, by the inputs that networks are trained with.

        The first is the input that the files of the network define. With a wrong range of values,
        a network may see objects everywhere, also in noise: another input has a sum of 0 then.
        """
        noise = np.random.default_rng(0).integers(0, 256, images_rgb[0].shape, np.uint8)
        own, found = self._head.convert, dict[str, float]()
        ranges = {own: '', _from_0_to_1: ' from 0 to 1', np.copy: ' from 0 to 255'}
        for order, step in (('RGB', 1), ('BGR', -1)):
            for scaled, values in ranges.items():
                self._head.convert = lambda pixels, scaled=scaled, step=step: scaled(  # type: ignore[misc]
                    np.ascontiguousarray(pixels[:, ::step]))
                found[order + values] = 0.0 if found and len(self.detect(noise)) > _IN_NOISE else \
                    sum(float(self.detect(image).scores.sum()) for image in images_rgb)
        self._head.convert = own
        return found

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Weak queries, and several texts of a class, give duplicate boxes of an object. They are
        removed, see ``iou``.
        """
        names = self._head.names
        rows = self._head.find(np.ascontiguousarray(image_rgb), self._options)
        numbers = np.array([self.class_names.index(names[int(row)]) for row in rows[:, 5]],
                           dtype=np.int64)
        if self._head.has_doubles:
            rows = rows[without_doubles(rows[:, :4], numbers, self._options.iou,
                                        self._options.max_det)]
        return Detections(bboxes_xyxy=rows[:, :4].astype(np.float64),
                          class_ids=tuple(names[int(row)] for row in rows[:, 5]),
                          scores=rows[:, 4].astype(np.float64))


def is_grey(image_rgb: NDArray[np.uint8]) -> bool:
    """Return whether an image (h, w, 3) has no colours and is not black."""
    pixels = image_rgb[::4, ::4].astype(np.int16)
    return bool(np.ptp(pixels, axis=2).mean() < _GREY_LEVELS and np.ptp(pixels) >= _BLACK_LEVELS)


def load_detector(options: DetectorOptions) -> OnnxDetector:
    """Load a detector; weights of ultralytics are exported to ONNX at their first use.

    Raises
    ------
    ModelError
        The weights are missing or damaged, are not those of a detection model, or cannot be
        exported, for example without PyTorch.
    OptionsError
        The options name prompts for a network with fixed classes.
    """
    path = Path(options.model).expanduser()
    if is_hub_name(options.model) or path.suffix == '.onnx' or path.is_dir():
        return OnnxDetector(options)
    from cliploc_ros.models.yolo_weights import export_detector, resolve_published

    file = resolve_published(options.model, options.cache_dir, 'model')
    identity = [digest_file(file, options.cache_dir)]
    if options.prompts:
        tower = Path(options.text_model).expanduser()
        identity += [digest_file(tower, options.cache_dir) if tower.is_file()
                     else options.text_model, json.dumps(options.prompts)]
    folder = exported(options.cache_dir, 'YOLO', str(file), identity,
                      partial(export_detector, file, options))
    return OnnxDetector(replace(options, model=str(folder / DETECTOR), prompts=()))


def _from_0_to_1(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    return pixels / np.float32(255)


class YoloHead:
    """An export of ultralytics, with a letterbox before it and removal of duplicates after it.

    Class names are in its metadata, or in ``config.json`` for files of other programs.
    """

    def __init__(self, network: OnnxNetwork) -> None:
        self._network, self._input = network, network.image_input()
        about = network.metadata
        task = about.get('task', 'detect')
        if task not in ('detect', 'segment'):  # YOLOE is published with a head for masks
            raise ModelError(f"{network.file} is a YOLO model for the task '{task}': give a model "
                             "for 'detect'")
        self.names = _names(network)
        # several texts of a class
        self.has_doubles = len(set(self.names.values())) < len(self.names)
        stride = about.get('stride', '')[:9]
        self._stride = int(numbers({'stride': int(stride) if stride.isdecimal() else _STRIDE},
                                   network.file, 'stride', 1, 1, _MOST_STRIDE)[0])
        height, width = self._input.shape[2:]
        self._size = None if ANY in (height, width) else (height, width)
        #: Converts an RGB image (1, 3, h, w), 0 to 255, to the input of the network
        self.convert: Callable[[NDArray[np.float32]], NDArray[np.float32]] = _from_0_to_1
        self._is_end2end = self._removes_doubles(self._run(np.zeros((1, 3, *(
            self._size or (2 * self._stride,) * 2)))))

    def _run(self, pixels: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the output, boxes with scores, for an input with values in 0 to 1."""
        outputs = self._network(**{self._input.name: pixels.astype(self._input.type)})
        boxes = [output for output in outputs.values() if output.ndim == 3 and len(output) == 1]
        if len(boxes) != 1:
            raise ModelError(
                f'{self._network.file} is not a detector: its outputs are '
                f'{ {name: output.shape for name, output in outputs.items()} }, expected one of '
                f"shape (1, boxes, classes), or '{_LOGITS}' and '{_BOXES}'")
        return boxes[0][0]

    def _removes_doubles(self, output: NDArray[np.float32]) -> bool:
        """Return whether the network removes duplicates itself, by an output; see select_boxes."""
        count, task = len(self.names), self._network.metadata.get('task')
        if output.shape[0] == 4 + count:
            return False
        if task and output.shape[1] == _END2END:  # without a task: YOLOv5, with other columns
            return True
        if task == 'segment':  # YOLOE's masks follow the classes
            if self._network.metadata.get('end2end') == 'True' and output.shape[1] > _END2END:
                return True
            if output.shape[0] > 4 + count:
                return False
        raise ModelError(f'{self._network.file} is not a detector of {count} classes: its output '
                         f'has the shape {output.shape}, expected ({4 + count}, boxes) or '
                         '(boxes, 6)')

    def find(self, image_rgb: NDArray[np.uint8], options: DetectorOptions) -> NDArray[np.float32]:
        """Return the boxes (n, 6) in an image: left, top, right, bottom, score, class.

        The image is scaled and centred in grey borders. The most confident box is first.
        """
        side = -(-options.imgsz // self._stride) * self._stride
        height, width = self._size or (side, side)
        size = image_rgb.shape[1::-1]
        scale = min(height / size[1], width / size[0])
        scaled = max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
        free_x, free_y = width - scaled[0], height - scaled[1]
        if self._size is None:  # the input shrinks to a multiple of the stride
            free_x, free_y = free_x % self._stride, free_y % self._stride
        left, top = round(free_x / 2 - 0.1), round(free_y / 2 - 0.1)
        image = image_rgb if scaled == size else \
            cv2.resize(image_rgb, scaled, interpolation=cv2.INTER_LINEAR)
        filled = cv2.copyMakeBorder(image, top, free_y - top, left, free_x - left,
                                    cv2.BORDER_CONSTANT, value=_GREY)
        output = self._run(self.convert(np.ascontiguousarray(filled.transpose(2, 0, 1)[None],
                                                             np.float32)))
        if not self._is_end2end:
            output = output[:4 + len(self.names)]
        rows = select_boxes(output, options.conf, options.iou, options.max_det, self._is_end2end)
        ours, theirs, corner = (np.array(pair * 2, dtype=np.float32)
                                for pair in (scaled, size, (left, top)))
        boxes = np.clip((rows[:, :4] - corner) / (ours / theirs), 0, theirs)
        return np.hstack([boxes, rows[:, 4:]])


class DetrHead:
    """A network like DETR, with logits and boxes of queries, as exported by transformers.

    ``config.json`` has the class names, ``preprocessor_config.json`` the preparation of images.
    """

    has_doubles = True  # from weak queries

    def __init__(self, network: OnnxNetwork) -> None:
        self._network, self._input = network, network.image_input()
        self.names = _names(network)
        file = _beside(network.file, _PREPROCESSOR)
        about = read_config(file, 'it defines the preparation of images')
        size, fixed = about.get('size'), self._input.shape[2:]
        if isinstance(size, dict):
            size = {side: int(numbers(size, file, side, 1, 1, _MOST_PX)[0])
                    for side in _SIDES if size.get(side) is not None}
        if not isinstance(size, dict) or not ({'height', 'width'} <= size.keys()
                                              or 'shortest_edge' in size):
            raise ModelError(f"{file}: the field 'size' has neither height and width nor "
                             f'shortest_edge: {str(size)[:80]}')
        if ANY not in fixed:
            if 'height' in size and (size['height'], size['width']) != fixed:
                raise ModelError(f'{file} has the size {size}, but {network.file} takes '
                                 f'{fixed[0]} x {fixed[1]}: they are not from the same network')
            size = {'height': fixed[0], 'width': fixed[1]}
        self._size: dict[str, int] = size
        self._scale, self._mean, self._deviation = (
            found.astype(np.float32) for found in colours(about, file))
        self._resample = Image.Resampling(one_of(about, file, 'resample', (2, 0, 1, 3, 4, 5)))
        #: See YoloHead.convert
        self.convert: Callable[[NDArray[np.float32]], NDArray[np.float32]] = lambda pixels: (
            pixels * self._scale - self._mean[:, None, None]) / self._deviation[:, None, None]
        probe = self._run(np.zeros((64, 64, 3), dtype=np.uint8))[_LOGITS]
        #: Whether the last logit of a query means 'no object'
        self._has_nothing = probe.shape[-1] == len(self.names) + 1
        if probe.shape[-1] not in (len(self.names), len(self.names) + 1):
            raise ModelError(f'{network.file} has {probe.shape[-1]} classes, but {_CONFIG} has '
                             f'{len(self.names)}: they are not from the same network')

    def _run(self, image_rgb: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
        """Return logits (q, c) and boxes (q, 4) for an image (h, w, 3)."""
        height, width = image_rgb.shape[:2]
        if 'height' in self._size:
            size = self._size['width'], self._size['height']
        else:
            scale = min(self._size['shortest_edge'] / min(height, width),
                        self._size.get('longest_edge', np.inf) / max(height, width))
            size = max(1, round(width * scale)), max(1, round(height * scale))
        # OpenCV's bilinear filter skips pixels when scaling down, Pillow's does not
        scaled = np.asarray(Image.fromarray(image_rgb).resize(size, self._resample))
        given: dict[str, NDArray[Any]] = {self._input.name: self.convert(np.ascontiguousarray(
            scaled.transpose(2, 0, 1)[None], np.float32)).astype(self._input.type)}
        for port in self._network.inputs:
            if port.name == 'pixel_mask':  # 1 for pixels of the image, 0 for padding
                shape = [size[1] if side == ANY else side for side in port.shape[1:]]
                if port.shape[1:] == (ANY, ANY):
                    shape = [size[1], size[0]]
                given[port.name] = np.ones((1, *shape), dtype=port.type or np.int64)
            elif port.name != self._input.name:
                raise ModelError(f"{self._network.file} has the input '{port.name}', which is "
                                 'unknown: export it with images as its only input')
        outputs = self._network(**given)
        return {name: outputs[name][0] for name in (_LOGITS, _BOXES)}

    def find(self, image_rgb: NDArray[np.uint8], options: DetectorOptions) -> NDArray[np.float32]:
        """Return the boxes (n, 6) in an image, see YoloHead.find."""
        found = self._run(image_rgb)
        logits = found[_LOGITS].astype(np.float64)
        scores: NDArray[Any]
        if self._has_nothing:
            shares: NDArray[np.float64] = np.exp(logits - logits.max(axis=1, keepdims=True))
            scores = (shares / shares.sum(axis=1, keepdims=True))[:, :-1]
            queries, classes = np.arange(len(scores)), scores.argmax(axis=1)
        else:
            # Like transformers, keep the n best pairs of a query and a class for n queries.
            scores = 1.0 / (1.0 + np.exp(-logits))
            best = np.argsort(-scores, axis=None, kind='stable')[:len(scores)]
            queries, classes = np.unravel_index(best, scores.shape)
        chosen = scores[queries, classes]
        order = np.argsort(-chosen, kind='stable')
        order = order[chosen[order] > options.conf]
        middle, size = np.split(found[_BOXES][queries[order]], [2], axis=1)
        half = size / 2
        sides = np.array(image_rgb.shape[1::-1] * 2, dtype=np.float32)
        boxes = np.clip(np.hstack([middle - half, middle + half]) * sides, 0, sides)
        return np.hstack([boxes, chosen[order, None], classes[order, None]]).astype(np.float32)


def _beside(file: Path, name: str) -> Path:
    """Return a file next to a network, or above the folder ``onnx`` of a published network."""
    above = file.parent.parent / name
    is_above = file.parent.name == 'onnx' and not (file.parent / name).exists() and above.exists()
    return above if is_above else file.parent / name


def _names(network: OnnxNetwork) -> dict[int, str]:
    """Read the class names by index, from the metadata or from config.json."""
    where, found = f'{network.file}', None
    if text := network.metadata.get('names'):
        try:
            found = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
            raise ModelError(f'{where}: the class names in its metadata cannot be read; export '
                             'the network again') from error
    else:
        file = _beside(network.file, _CONFIG)
        where = f"{file}: the field 'id2label'"
        found = read_config(file, f'{network.file} has no class names').get('id2label')
    if isinstance(found, list):
        found = dict(enumerate(found))
    if not isinstance(found, dict) or sorted(map(str, found)) != sorted(
            map(str, range(len(found)))) or not found:
        raise ModelError(f'{where} must have class names with the keys 0, 1 ...')
    for number, name in found.items():
        # a boolean is an int, too
        if type(name) not in (str, int) or not 0 < len(str(name).strip()) <= _MOST_NAME:
            raise ModelError(f'{where}: class {number} has the name {str(name)[:80]!r}, expected '
                             f'a text of 1 to {_MOST_NAME} characters: add it')
    return {int(number): str(name) for number, name in found.items()}


# ---- boxes of YOLO, as in ultralytics -----------------------------------------------------------

def select_boxes(output: NDArray[np.float32], conf: float, iou: float, max_det: int,
                 is_end2end: bool) -> NDArray[np.float32]:
    """Return the boxes (n, 6) of an output: left, top, right, bottom, score, class.

    The output is (4 + classes, boxes), with centre and size of each box. A network that removes
    duplicates itself has the output (boxes, 6 or more), the most confident box first.
    """
    if is_end2end:
        return output[output[:, 4] > conf][:max_det, :_END2END]
    scores = output[4:].max(axis=0)
    rows = np.flatnonzero(scores > conf)
    rows = rows[np.argsort(-scores[rows], kind='stable')[:_MOST_BOXES]]
    middle, half = output[:2, rows].T, output[2:4, rows].T / 2
    classes = output[4:, rows].argmax(axis=0)
    boxes = np.hstack([middle - half, middle + half])
    kept = without_doubles(boxes, classes, iou, max_det)
    return np.hstack([boxes, scores[rows][:, None], classes[:, None]])[kept].astype(np.float32)


def without_doubles(boxes_xyxy: NDArray[np.floating], classes: NDArray[np.number], iou: float,
                    most: int) -> NDArray[np.int64]:
    """Return the rows of boxes (n, 4) that remain after non-maximum suppression by class.

    The boxes are sorted, the best first. A box is dropped if its IoU with a kept box of its class
    exceeds ``iou``.
    """
    left, top, right, bottom = boxes_xyxy.T
    areas = (right - left) * (bottom - top)
    is_open = np.ones(len(boxes_xyxy), dtype=bool)
    kept: list[int] = []
    for row in range(len(boxes_xyxy)):
        if not is_open[row]:
            continue
        kept.append(row)
        if len(kept) == most:
            break
        later = row + 1 + np.flatnonzero(is_open[row + 1:] & (classes[row + 1:] == classes[row]))
        width = np.minimum(right[row], right[later]) - np.maximum(left[row], left[later])
        height = np.minimum(bottom[row], bottom[later]) - np.maximum(top[row], top[later])
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        # not divided by the union, which is 0 for boxes without area
        is_open[later[shared > np.float32(iou) * (areas[row] + areas[later] - shared)]] = False
    return np.array(kept, dtype=np.int64)
