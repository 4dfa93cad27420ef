# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""XFeat: local features from a small network, in OpenVINO on a CPU.

Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024. The authors
publish the network for images of 640 x 640. Here it takes images of any size, with the same
weights.
"""

import hashlib
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.features import SIFT, FeatureKind, FeatureKinds, Features, compact
from cliploc_ros.errors import ModelError, first_line
from cliploc_ros.files.storage import read_file, replace_file, resolve_cache_dir
from cliploc_ros.models.files import download

if TYPE_CHECKING:  # loaded where a layer has these features
    from cliploc_ros.models.onnx_network import CompiledNetwork

XFEAT = 'xfeat-64-uint8'
FILE_NAME = 'xfeat.onnx'
_URL = ('https://raw.githubusercontent.com/verlab/accelerated_features/'
        'c58e74fc86c0e1f9038e0fb8807de59d27dd30d5/weights/xfeat.onnx')
_SHA256 = '54041f61f0d9b1968451a65fe0fd79e96692b1d8266c54a6939a73e847df5988'
_PATIENCE_S = 10.0
WITHOUT_XFEAT = 'or make the layer again with build_map --keyframe-features sift'
# Sides of an input are multiples of _STEP; a cell of the outputs has _CELL x _CELL pixels.
_STEP, _CELL = 32, 8
_DIMENSIONS = 64
# See FeatureKind. By chance, up to 20 features agree with poses at other places.
_ZERO, _SCALE, _RATIO, _LEAST_INLIERS = 128, 256.0, 0.95, 21
_QUERY_PX, _QUERY_MOST = 640, 2000
# As in XFeat: a feature is a maximum among its neighbours, with at least this likelihood.
_BESIDE, _LEAST = np.ones((5, 5), dtype=np.uint8), 0.05
# Tensors of the published network: the normalized image, its cells of 8 x 8 pixels as channels,
# and two feature maps that are enlarged, with their factors.
_IMAGE, _CELLS, _ENLARGED = '126', '1250', {'226': 2.0, '241': 4.0}


def feature_kinds(cache_dir: str = '') -> FeatureKinds:
    """Return the kinds of features of layers, by name; see load_xfeat."""
    return {SIFT.name: lambda: SIFT, XFEAT: partial(load_xfeat, cache_dir)}


def load_xfeat(cache_dir: str = '') -> FeatureKind:
    """Load XFeat; its file of 2.7 MB is downloaded once.

    ModelError: the file is missing and cannot be downloaded, or differs from the published file,
    or OpenVINO is not installed or cannot run it.
    """
    folder = resolve_cache_dir(cache_dir) / 'weights'
    file = folder / FILE_NAME

    def fetch() -> Path:
        from urllib.request import urlopen

        with urlopen(_URL, timeout=_PATIENCE_S) as answer:
            content = answer.read(2**26)  # a limit, in case the server does not stop sending
        if not _is_published(content):
            raise ValueError('the server sent another file')
        with replace_file(file) as partial_file:
            partial_file.write_bytes(content)
        return file
    if not file.exists():
        download(FILE_NAME, folder, f'Without a network: download {_URL} on another machine into '
                 f'{folder}, {WITHOUT_XFEAT}', fetch)
    _network(file)
    return FeatureKind(XFEAT, _DIMENSIONS, partial(_extract, file), _ZERO, _SCALE, _RATIO,
                       _LEAST_INLIERS, _QUERY_PX, _QUERY_MOST)


def _is_published(content: bytes) -> bool:
    """Return whether a file is the published one; in other files, the tensors' names differ."""
    return hashlib.sha256(content).hexdigest() == _SHA256


@cache
def _network(file: Path) -> 'CompiledNetwork':
    """Load the network of a file; ModelError: see load_xfeat."""
    from cliploc_ros.models.onnx_network import CompiledNetwork, import_openvino

    try:
        is_published = _is_published(read_file(file))
    except OSError as error:
        raise ModelError(f'{file} cannot be read: {error.strerror}, {WITHOUT_XFEAT}') from error
    if not is_published:
        raise ModelError(f'{file} is not the published XFeat (SHA-256 {_SHA256}): remove it, '
                         f'{WITHOUT_XFEAT}')
    try:
        return CompiledNetwork.of(any_size(import_openvino().Core().read_model(file)))
    except ModelError as error:
        raise ModelError(f'{error}, {WITHOUT_XFEAT}') from error
    except Exception as error:  # OpenVINO has no exception classes
        raise ModelError(f'OpenVINO cannot run {file}: {first_line(error)}; update OpenVINO, '
                         f'{WITHOUT_XFEAT}') from error


def any_size(network: Any) -> Any:
    """Change the published network to take images of any size, and to have one output.

    The channels of the output (1, 130, h / 8, w / 8) are the descriptor as unit vector (64), the
    likelihoods that each pixel of the cell is a feature (64) and that none is (1), and the
    reliability (1).
    """
    from openvino import Model
    from openvino import opset13 as layers

    tensors = {name: output for node in network.get_ops() for output in node.outputs()
               for name in output.names}
    # the published network slices the cells of 640 x 640 pixels one by one
    tensors[_CELLS].replace(layers.space_to_depth(
        tensors[_IMAGE], 'blocks_first', _CELL).output(0))
    for name, factor in _ENLARGED.items():
        small = tensors[name].get_node().input_value(0)
        tensors[name].replace(layers.interpolate(
            small, np.full(2, factor, np.float32), 'linear_onnx', 'scales', axes=[2, 3],
            coordinate_transformation_mode='pytorch_half_pixel').output(0))
    descriptors, likely, reliable = (result.input_value(0) for result in network.get_results())
    joined = layers.concat([layers.normalize_l2(descriptors, np.array([1]), 1e-12, 'max'),
                            layers.softmax(likely, 1), reliable], 1)
    found = Model([layers.result(joined)], network.get_parameters(), 'xfeat')
    found.reshape([1, 3, -1, -1])
    return found


def _extract(file: Path, image_rgb: NDArray[np.uint8], most: int, longest_side_px: int
             ) -> Features:
    """Extract the strongest features of an image (h, w, 3), see FeatureKind."""
    sides = np.array(image_rgb.shape[1::-1])
    scale = min(1.0, longest_side_px / sides.max())
    size = np.maximum(1, (scale * sides).astype(np.int64) // _STEP) * _STEP
    image = cv2.resize(image_rgb, size.tolist(), interpolation=cv2.INTER_AREA)
    found = _network(file)(np.asarray(cv2.dnn.blobFromImage(image, 1.0 / 255.0)))[0][0]
    columns, rows = size // _CELL
    likely = found[_DIMENSIONS:-2].reshape(_CELL, _CELL, rows, columns)
    likely = np.ascontiguousarray(likely.transpose(2, 0, 3, 1)).reshape(size[::-1])
    y, x = np.nonzero((likely == cv2.dilate(likely, _BESIDE)) & (likely > _LEAST))
    strengths = (likely * cv2.resize(found[-1], size.tolist()))[y, x]
    order = np.argsort(-strengths, kind='stable')[:most]
    pixels = np.column_stack([x, y])[order] + 0.5
    units = _sampled(np.ascontiguousarray(found[:_DIMENSIONS].transpose(1, 2, 0)),
                     pixels / _CELL - 0.5)
    units /= np.maximum(np.linalg.norm(units, axis=1, keepdims=True), 1e-9)
    return Features(pixels / (size / sides) - 0.5, compact(units, _ZERO, _SCALE), strengths[order])


def _sampled(cells: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """Interpolate cells (h, w, d) at places (n, 2) by bicubic interpolation, giving (n, d)."""
    beside = np.floor(places).astype(np.int64)[..., None] + np.arange(-1, 3)
    off = np.abs(places[..., None] - beside)
    weights = np.where(off < 1.0, (1.25 * off - 2.25) * off**2 + 1.0,
                       ((-0.75 * off + 3.75) * off - 6.0) * off + 3.0).astype(np.float32)
    x, y = np.clip(beside, 0, np.array(cells.shape[1::-1])[:, None] - 1).transpose(1, 0, 2)
    near = cells[y[:, :, None], x[:, None]].reshape(-1, 16, cells.shape[2])
    return ((weights[:, 1, :, None] * weights[:, 0, None]).reshape(-1, 1, 16) @ near)[:, 0]
