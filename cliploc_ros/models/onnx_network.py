# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A network in an ONNX file, run by OpenVINO on a CPU, with a cache of compiled networks."""

import contextlib
import hashlib
import logging
import os
import threading
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ModelError
from cliploc_ros.files.storage import parse_json, read_file, resolve_cache_dir
from cliploc_ros.models.devices import count_threads, import_openvino
from cliploc_ros.models.files import (
    check_weights_file,
    damaged,
    fingerprint_file,
    first_line,
    remove_unused,
)
from cliploc_ros.models.openvino_networks import release_pages

# A compiled network is as large as its file: ViT-L-14 takes 1.2 GB, YOLOv8x .3 GB.
_MOST_NETWORKS = 8
_FLOATS: dict[str, type[np.number[Any]]] = {'f32': np.float32, 'f16': np.float16}
_INTEGERS: dict[str, type[np.number[Any]]] = {'i64': np.int64, 'i32': np.int32}
#: A size of an input that varies.
ANY = -1

logger = logging.getLogger(__name__)


class Input(NamedTuple):
    """An input of a network."""

    name: str
    shape: tuple[int, ...]  #: ANY where a size varies
    type: type[np.number[Any]] | None  #: None for one that no image or text can be fed as


class OnnxNetwork:
    """A network of an ONNX file: inputs by their names in, outputs by their names out.

    OpenVINO keeps compiled networks in the folder ``openvino`` of the cache, each in a folder that
    is named after the content of the file. It runs a damaged one without an error (measured: boxes
    off by 20 px), so each has its SHA-256 beside it, and is compiled again where that differs.

    ModelError: the file is missing, damaged, or holds operations that OpenVINO does not know.

    Parameters
    ----------
    precision : str or None
        'f32', or None for the processor's own choice: bf16 where it multiplies matrices in it.
    """

    def __init__(self, file: Path, cache_dir: str, precision: str | None = 'f32') -> None:
        check_weights_file(file)
        openvino = import_openvino()
        if openvino is None:
            raise ModelError(f'{file} needs OpenVINO, which is not installed: pip install '
                             'openvino')
        self.file = file
        core = openvino.Core()
        try:
            network = core.read_model(file)
        except Exception as error:  # OpenVINO has no exceptions of its own
            raise _unreadable(file, str(error)) from error
        about = network.get_rt_info()
        #: What the program that wrote the file says of it
        self.metadata: dict[str, str] = {
            name: str(value.value) for name, value in about['framework'].items()
        } if 'framework' in about else {}
        # A pinned thread waits for other processes on its core. The number of threads is that of
        # PyTorch, whose limits apply here, too.
        settings: dict[str, Any] = {
            'PERFORMANCE_HINT': 'LATENCY', 'NUM_STREAMS': 1, 'ENABLE_CPU_PINNING': False,
            'INFERENCE_NUM_THREADS': count_threads()}
        if precision is not None:
            settings['INFERENCE_PRECISION_HINT'] = precision
        folder = resolve_cache_dir(cache_dir) / 'openvino' / (
            f'{file.stem}-{fingerprint_file(file)[:32]}')
        _forget_damaged(folder)
        try:
            self._compiled = core.compile_model(network, 'CPU',
                                                settings | {'CACHE_DIR': str(folder)})
        except Exception as error:
            raise ModelError(f'OpenVINO does not run {file}: {first_line(error)}; export the '
                             'network again, without quantization') from error
        del network
        _keep(folder)
        self._lock = threading.Lock()
        self.inputs = tuple(_described(port) for port in self._compiled.inputs)
        self.outputs = tuple(_name_of(port) for port in self._compiled.outputs)

    def __call__(self, **inputs: NDArray[Any]) -> dict[str, NDArray[np.float32]]:
        """Return the outputs for some inputs; both by name."""
        with self._lock:  # a compiled network runs one input at a time
            found = self._compiled(inputs)
            return {name: np.array(found[number], dtype=np.float32)
                    for number, name in enumerate(self.outputs)}

    def image_input(self) -> Input:
        """Return the input that takes images (n, 3, h, w); ModelError: there is none."""
        images = [one for one in self.inputs if len(one.shape) == 4]
        if len(images) != 1 or images[0].shape[0] not in (1, ANY) or (
                images[0].shape[1] not in (3, ANY)):
            raise ModelError(f'{self.file} takes no single colour image: its inputs are '
                             f'{self.described_inputs()}, expected (1, 3, height, width)')
        if images[0].type not in _FLOATS.values():
            raise ModelError(f'{self.file} takes images that are no floating-point numbers '
                             f'({self.described_inputs()}), and nothing says how they are scaled: '
                             'export it with inputs in fp32')
        return images[0]

    def described_inputs(self) -> str:
        """Return names and shapes of the inputs for a message."""
        return ', '.join(f"'{one.name}' {one.shape}" for one in self.inputs)


def read_config(file: Path, purpose: str) -> dict[str, Any]:
    """Return the JSON object of a file beside a network; ModelError: it is missing or damaged.

    The error says what it is needed for.
    """
    try:
        found = parse_json(read_file(file))
    except FileNotFoundError:
        raise ModelError(f'{file} is missing, and {purpose}: put the one of the published '
                         'network there') from None
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f'{file} cannot be read: {first_line(error)}') from error
    if not isinstance(found, dict):
        raise ModelError(f'{file} is no JSON object: download it again')
    return found


def _unreadable(file: Path, reason: str) -> ModelError:
    if "can't be parsed" in reason:
        return damaged(file, 'its graph ends too early')
    if 'externally stored data' in reason:
        name = reason.partition('(')[2].partition(',')[0]
        return ModelError(f'the weights of {file} are in a file of their own, {name}, which is '
                          'missing: put it beside the network')
    lines = [line.strip() for line in reason.splitlines() if line.strip()]
    return ModelError(f'OpenVINO does not read {file}: {" ".join(lines[-2:])[:300]}; update '
                      'OpenVINO, or export the network with an opset of 11 to 21')


def _described(port: Any) -> Input:
    shape = tuple(ANY if size.is_dynamic else size.get_length() for size in port.partial_shape)
    return Input(_name_of(port), shape,
                 (_FLOATS | _INTEGERS).get(port.element_type.get_type_name()))


def _name_of(port: Any) -> str:
    return min(port.names, default='')


def _forget_damaged(folder: Path) -> None:
    """Remove compiled networks that differ from what was written."""
    for blob in folder.glob('*.blob'):
        digest = blob.with_suffix('.sha256')
        if digest.is_file() and digest.read_text() == _digest(blob):
            continue
        if digest.is_file():  # else a process ended before it wrote the digest
            logger.warning('%s is damaged: compiling the network again', blob)
        with contextlib.suppress(OSError):
            digest.unlink(missing_ok=True)
            blob.unlink(missing_ok=True)


def _keep(folder: Path) -> None:
    """Write the digests of new compiled networks, and remove networks that are not used."""
    for blob in folder.glob('*.blob'):
        digest = blob.with_suffix('.sha256')
        with contextlib.suppress(OSError):  # a read-only cache works too
            if digest.is_file():
                os.utime(folder)
            else:
                digest.write_text(_digest(blob))
                remove_unused([one for one in folder.parent.iterdir() if one != folder], (),
                              _MOST_NETWORKS - 1)
        release_pages(blob)


def _digest(file: Path) -> str:
    with file.open('rb') as opened:
        return hashlib.file_digest(opened, 'sha256').hexdigest()
