# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Networks in ONNX files, run by OpenVINO on a CPU; compiled once and cached on disk.

OpenVINO, not ONNX Runtime 1.32: with instructions for bf16, OpenVINO encodes crops in half the
time (ViT-B-32). In fp32 the latencies are similar, and ONNX Runtime starts sooner and takes less
memory (studies/README.md).
"""

import contextlib
import ctypes
import gc
import hashlib
import json
import logging
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ModelError, first_line
from cliploc_ros.files import storage
from cliploc_ros.models.files import check_weights_file, digest_network, new_entry, weights_beside

# A compiled network is as large as its file: ViT-L-14 takes 1.2 GB, YOLOv8x .3 GB.
_MOST_NETWORKS = 8
# Version of the file of a compiled network; a change makes new files.
_FORMAT = 2
_TYPES: dict[str, type[np.number[Any]]] = {
    'f32': np.float32, 'f16': np.float16, 'i64': np.int64, 'i32': np.int32}
#: Marks a variable size of an input.
ANY = -1
# Greatest mean and deviation of colours, which are at most 255.
_MOST = 1000.0

logger = logging.getLogger(__name__)


class Input(NamedTuple):
    """An input of a network."""

    name: str
    shape: tuple[int, ...]  #: ANY where a size is variable
    type: type[np.number[Any]] | None  #: None for types that hold neither images nor tokens


class CompiledNetwork:
    """A network compiled by OpenVINO; it runs one request at a time."""

    def __init__(self, compiled: Any) -> None:
        self._compiled = compiled
        self._lock = threading.Lock()

    @staticmethod
    def of(network: Any) -> 'CompiledNetwork':
        """Compile an ``openvino.Model``, in fp32."""
        return CompiledNetwork(import_openvino().Core().compile_model(
            network, 'CPU', _settings('f32')))

    def __call__(self, inputs: Any) -> list[NDArray[np.float32]]:
        """Run the network on inputs, an array or a dictionary by name; return its outputs."""
        with self._lock:
            return [np.array(output, dtype=np.float32)
                    for output in self._compiled(inputs).values()]


class OnnxNetwork:
    """A network in an ONNX file, with inputs and outputs by name.

    Compiling takes seconds. The compiled network is therefore kept in the folder ``openvino`` of
    the cache, keyed by the content of the file, the processor and the version of OpenVINO.
    OpenVINO runs a damaged network without an error (measured: boxes off by 20 px), so its SHA-256
    is stored and checked, and that of the ONNX file if sha256sum has written it to NAME.sha256.

    It has as many threads as OMP_NUM_THREADS says when it is loaded, by default one for each core
    that the process may use.

    ModelError: the file is missing, damaged, or holds operations that OpenVINO does not support,
    or OpenVINO is not installed.

    Parameters
    ----------
    precision : str or None
        'f32', or None for the default of the processor: bf16 if it supports that.
    """

    def __init__(self, file: Path, cache_dir: str, precision: str | None = 'f32') -> None:
        check_weights_file(file)
        self.file = file
        # A compiled network is named by a hash of all that it depends on.
        openvino, content = import_openvino(), digest_network(file, cache_dir)
        with contextlib.suppress(FileNotFoundError):
            if storage.read_file(file.with_name(f'{file.name}.sha256')).split()[:1] != [
                    content.partition(':')[0].encode()]:
                raise ModelError(f'{file} differs from the digest in {file.name}.sha256: copy '
                                 'both again')
        depends = [_FORMAT, openvino.Core().get_property('CPU', 'FULL_DEVICE_NAME'),
                   openvino.get_version(), precision, content]
        digest = hashlib.sha256(json.dumps(depends).encode()).hexdigest()
        cache = storage.resolve_cache_dir(cache_dir) / 'openvino'
        stored = cache / f'{file.stem}-{digest[:32]}.blob'
        try:
            compiled, self.metadata = _load(stored, precision)
        except Exception as error:  # OpenVINO has no exception classes
            if stored.exists():
                logger.warning('%s cannot be used (%s): compiling %s again', stored,
                               first_line(error), file.name)
            if digest_network(file) != content:
                raise ModelError(f'{file} is damaged: its content differs from that of earlier '
                                 'starts; copy it again') from error
            compiled, self.metadata = _compile(file, stored, precision)
        self._network = CompiledNetwork(compiled)
        self.inputs = tuple(Input(
            _name_of(port),
            tuple(ANY if size.is_dynamic else size.get_length() for size in port.partial_shape),
            _TYPES.get(port.element_type.get_type_name())) for port in compiled.inputs)
        self.outputs = tuple(_name_of(port) for port in compiled.outputs)

    def __call__(self, **inputs: NDArray[Any]) -> dict[str, NDArray[np.float32]]:
        """Run the network on inputs by name; return its outputs by name."""
        return dict(zip(self.outputs, self._network(inputs), strict=True))

    def image_input(self) -> Input:
        """Return the input that takes images (n, 3, h, w); ModelError: there is none."""
        images = [port for port in self.inputs if len(port.shape) == 4]
        if len(images) != 1 or images[0].shape[0] not in (1, ANY) or (
                images[0].shape[1] not in (3, ANY)):
            raise ModelError(f'{self.file} takes no single colour image: its inputs are '
                             f'{self.described_inputs()}, expected (1, 3, height, width), '
                             'channels first: export it so (tf2onnx: --inputs-as-nchw)')
        if images[0].type not in (np.float32, np.float16):
            raise ModelError(f'{self.file} takes images of integers, whose scale is unknown '
                             f'({self.described_inputs()}): export it with inputs in fp32')
        return images[0]

    def described_inputs(self) -> str:
        """Return names and shapes of the inputs for a message."""
        return ', '.join(f"'{port.name}' {port.shape}" for port in self.inputs)


def read_config(file: Path, purpose: str) -> dict[str, Any]:
    """Read the JSON object of a file next to a network; ModelError: it is missing or damaged.

    The error states the purpose of the file. Fields that are null count as missing, as in
    transformers.
    """
    try:
        found = storage.parse_json(storage.read_file(file))
    except FileNotFoundError:
        raise ModelError(f'{file} is missing; {purpose}: put the file of the published network '
                         'there') from None
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f'{file} cannot be read: {first_line(error)}') from error
    if not isinstance(found, dict):
        raise ModelError(f'{file} is not a JSON object: download it again')
    return {name: value for name, value in found.items() if value is not None}


def one_of(about: dict[str, Any], file: Path, name: str, choices: Sequence[Any]) -> Any:
    """Return a field of a file, by default the first choice; ModelError: it is no choice."""
    value = about.get(name, choices[0])
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        raise ModelError(f"{file}: the field '{name}' is {str(value)[:80]!r}, expected one of "
                         f'{", ".join(map(str, choices))}: download the file again')
    return value


def numbers(about: dict[str, Any], file: Path, name: str, count: int, least: float, most: float
            ) -> NDArray[np.float64]:
    """Return the numbers (count,) of a field of a file; a single number counts for all.

    ModelError: it is missing, has another type or length, or a number is out of range.
    """
    value = about.get(name)
    found = value if isinstance(value, list) else [value] * count
    if len(found) != count or not all(
            isinstance(number, int | float) and not isinstance(number, bool)
            and least <= number <= most for number in found):
        raise ModelError(f"{file}: the field '{name}' is {str(value)[:80]!r}, expected {count} "
                         f'number(s) from {least:.4g} to {most:.4g}: download the file again')
    return np.array(found, dtype=np.float64)


def colours(about: dict[str, Any], file: Path) -> list[NDArray[np.float64]]:
    """Return scale (1,), mean (3,) and deviation (3,) of the colours, as transformers states them.

    ModelError: a field is missing or wrong.
    """
    if not one_of(about, file, 'do_rescale', (True, False)):
        about = about | {'rescale_factor': 1.0}
    if not one_of(about, file, 'do_normalize', (True, False)):
        about = about | {'image_mean': 0.0, 'image_std': 1.0}
    return [numbers({'rescale_factor': 1 / 255} | about, file, name, count, least, most)
            for name, count, least, most in (
                ('rescale_factor', 1, 1 / 2**16, 1.0), ('image_mean', 3, -_MOST, _MOST),
                ('image_std', 3, 1 / _MOST, _MOST))]


# ---- the process --------------------------------------------------------------------------------

@cache
def import_openvino() -> Any:
    """Import OpenVINO without its telemetry; ModelError: it is not installed."""
    # If this package can be imported, OpenVINO reports its import and all conversions to Google.
    sys.modules.setdefault('openvino_telemetry', None)  # type: ignore[arg-type]
    try:
        import openvino
    except ImportError as error:
        raise ModelError('networks need OpenVINO, which is not installed: pip install openvino, '
                         f"or the extra 'runtime' ({first_line(error)})") from error
    return openvino


def free_memory() -> None:
    """Return the memory of freed networks to the system."""
    gc.collect()
    # glibc keeps freed blocks below 32 MB, but other processes of a robot need the memory.
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)


def _settings(precision: str | None) -> dict[str, Any]:
    # No pinning: a pinned thread waits for other processes on its core.
    settings: dict[str, Any] = {
        'PERFORMANCE_HINT': 'LATENCY', 'NUM_STREAMS': 1, 'ENABLE_CPU_PINNING': False}
    if (threads := os.environ.get('OMP_NUM_THREADS', '')).isdecimal() and int(threads):
        settings['INFERENCE_NUM_THREADS'] = int(threads)
    return settings if precision is None else settings | {'INFERENCE_PRECISION_HINT': precision}


# ---- compiled networks on disk ------------------------------------------------------------------

def _load(stored: Path, precision: str | None) -> tuple[Any, dict[str, str]]:
    """Load a compiled network and its metadata, see _compile; any exception: it is unusable."""
    storage.check_owners(stored.parent)
    content = np.memmap(stored, dtype=np.uint8, mode='r')
    if hashlib.sha256(content[32:]).digest() != content[:32].tobytes():
        raise ValueError('it is damaged')
    end = 40 + int(content[32:40].view(np.uint64)[0])
    openvino = import_openvino()
    # Tensor copies the mapped file: OpenVINO also reads it later, when it may be truncated.
    compiled = openvino.Core().import_model(openvino.Tensor(np.ascontiguousarray(content[end:])),
                                            'CPU', _settings(precision))
    with contextlib.suppress(OSError):  # a read-only cache works too
        os.utime(stored)
    return compiled, json.loads(content[40:end].tobytes())


@contextlib.contextmanager
def _without_links(file: Path) -> Iterator[Path]:
    """Yield the path of a network whose files of weights are in its folder.

    The hub's cache has links to files in another folder, which OpenVINO refuses to follow.
    """
    beside = [path for path in weights_beside(file) if path.is_file() and '..' not in path.parts
              and path.is_relative_to(file.parent)]
    if not any(path.is_symlink() for path in beside):
        yield file
        return
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_network_') as desk:
        for path in (file, *beside):
            whole = Path(desk) / path.relative_to(file.parent)
            whole.parent.mkdir(parents=True, exist_ok=True)
            try:
                whole.hardlink_to(path.resolve())
            except OSError:  # on another disk
                shutil.copyfile(path, whole)
        yield Path(desk) / file.name


def _compile(file: Path, stored: Path, precision: str | None) -> tuple[Any, dict[str, str]]:
    """Compile and store a network; return it with the metadata of its file.

    The stored file has the SHA-256 of its other parts: the size of the metadata in JSON (8 bytes),
    the metadata, the network.
    """
    core = import_openvino().Core()
    try:
        with _without_links(file) as whole:
            network = core.read_model(whole)
    except Exception as error:  # OpenVINO has no exception classes
        # its last lines name the cause, such as a missing file of weights
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise ModelError(f'OpenVINO cannot read {file}: {" ".join(lines[-2:])[:300]}; download it '
                         'again with all its files, update OpenVINO, or export it with an opset '
                         'of 11 to 21') from error
    about = network.get_rt_info()
    metadata: dict[str, str] = {
        name: str(value.value) for name, value in about['framework'].items()
    } if 'framework' in about else {}
    try:
        compiled = core.compile_model(network, 'CPU', _settings(precision))
    except Exception as error:
        raise ModelError(f'OpenVINO cannot run {file}: {first_line(error)}; export the network '
                         'again, without quantization') from error
    del network
    try:
        text = json.dumps(metadata).encode()
        blob = compiled.export_model()
        parts = (len(text).to_bytes(8, sys.byteorder), text,
                 blob if isinstance(blob, bytes) else blob.getbuffer())
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
        with new_entry(stored, _MOST_NETWORKS) as partial, partial.open('wb') as opened:
            opened.writelines((digest.digest(), *parts))
        # Loaded from the file, so that the weights are in memory once, and the file is checked.
        compiled, _ = _load(stored, precision)
    except Exception as error:  # OpenVINO's errors for a full disk and a bad network are the same
        storage.warn_not_kept(f'the compiled network is not cached: cannot write {stored} '
                              f'({first_line(error)}); {storage.MAKE_ROOM} (cache_dir)')
    free_memory()
    return compiled, metadata


def _name_of(port: Any) -> str:
    return min(port.names, default='')
