# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Networks that OpenVINO runs on a CPU: converted once, kept on disk, checked at each start."""

import contextlib
import ctypes
import hashlib
import json
import logging
import os
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError, ModelError
from cliploc_ros.files.storage import parse_json, read_file, resolve_cache_dir, warn_not_kept
from cliploc_ros.models.devices import count_threads, free_memory, import_openvino
from cliploc_ros.models.files import fingerprint_file, first_line, remove_unused

if TYPE_CHECKING:
    import torch

# Of this folder, and of how the modules here convert.
_FORMAT = 2
# ViT-L-14 takes 1.2 GB, YOLOv8x .3 GB.
_MOST_NETWORKS = 8
_XML, _WEIGHTS, _PROBE = 'network.xml', 'network.bin', 'probe.npz'
#: The file that a folder with a converted network has, and no export of ultralytics.
ABOUT = 'about.json'
#: Precisions to try, the fastest first, and how far an output may be off, as a share of its
#: length. None is the processor's own choice: bf16 where it multiplies matrices in it.
FP32 = (('f32', 1e-3),)  # measured: 1e-5
FASTEST = ((None, 0.03), *FP32)  # .03 is a cosine of .9995; measured in bf16: .99995
Precisions = Sequence[tuple[str | None, float]]
_MADV_DONTNEED = 4

logger = logging.getLogger(__name__)


class ConversionError(ModelError):
    """OpenVINO cannot run a network, or gives other results than PyTorch."""


class Conversion(NamedTuple):
    """A network that was converted."""

    network: Any
    #: An input; its shape is not the shape that the network was traced with
    probe: NDArray[Any]
    expected: NDArray[np.float32]  #: What PyTorch makes of the probe
    about: dict[str, Any]  #: What else the user of the network needs, as JSON
    arrays: Mapping[str, NDArray[Any]] = MappingProxyType({})  #: The same, as arrays


class Network:
    """A compiled network with one input and one output that is used.

    ``about`` and ``arrays`` are as in Conversion, the precision 'f32'; None is the processor's own
    choice.
    """

    def __init__(self, network: Any, about: dict[str, Any], precision: str | None = 'f32',
                 arrays: Mapping[str, NDArray[Any]] = MappingProxyType({})) -> None:
        self.about = about
        self.arrays = arrays
        # A pinned thread waits for other processes on its core. The number of threads is that of
        # PyTorch, whose limits apply here, too.
        settings = {'PERFORMANCE_HINT': 'LATENCY', 'NUM_STREAMS': 1, 'ENABLE_CPU_PINNING': False,
                    'INFERENCE_NUM_THREADS': count_threads()}
        if precision is not None:
            settings['INFERENCE_PRECISION_HINT'] = precision
        self._compiled = import_openvino().Core().compile_model(network, 'CPU', settings)
        self._lock = threading.Lock()

    def __call__(self, inputs: NDArray[Any]) -> NDArray[np.float32]:
        """Return the first output for some inputs."""
        with self._lock:  # a compiled network runs one input at a time
            return np.asarray(self._compiled(inputs)[0])


def load_network(cache_dir: str, name: str, identity: Sequence[str],
                 convert: Callable[[], Conversion], precisions: Precisions = FP32,
                 beside: Path | None = None) -> Network:
    """Return a network from the cache, or convert it, which takes seconds to minutes.

    The name of a folder in the cache is the hash of everything that the network depends on. A
    start runs a stored input and compares the output with PyTorch's, so that a damaged file, and
    a CPU that calculates otherwise, are noticed. Folders are written under another name and
    renamed: any number of processes may share the cache. A folder ``openvino`` beside the file of
    weights is a second cache, which is only read.

    The name is for people. The identity is the weights and their architecture: no library is
    imported to know it. The first precision in which the network runs as in PyTorch is taken, see
    FP32.

    ConversionError: OpenVINO cannot run the network as PyTorch does. ModelError: from convert.
    ModuleNotFoundError: the network has to be converted, and PyTorch is not installed.
    """
    for folder in stored_folders(cache_dir, name, identity, beside):
        try:
            network = open_stored(folder, precisions, identity)
        except Exception as error:  # OpenVINO has no exceptions of its own
            logger.warning('%s cannot be used (%s): converting %s again', folder,
                           first_line(error), name)
        else:
            with contextlib.suppress(OSError):  # a read-only cache works too
                os.utime(folder)
            return network
    started = time.monotonic()
    folder = network_folder(resolve_cache_dir(cache_dir), name, identity)
    logger.info('converting %s for OpenVINO: once, into %s', name, folder)
    try:
        conversion = convert()
    except (CliplocError, ModuleNotFoundError):
        raise
    except Exception as error:  # tracing and converting raise exceptions of all kinds
        raise ConversionError(f'OpenVINO cannot convert {name}: {first_line(error)}') from error
    try:
        network = store_network(folder, identity, conversion, precisions)
    except Exception as error:  # OpenVINO reports a full disk as it reports a bad network
        try:
            network = _checked(conversion, precisions)
        except Exception as failure:
            raise ConversionError(f'OpenVINO does not run {name} as PyTorch does: '
                                  f'{first_line(failure)}') from failure
        warn_not_kept('the converted network is not cached and the next start is slow again: '
                      f'cannot write {folder} ({first_line(error)}); make room, or choose a '
                      'writable cache_dir')
    del conversion
    free_memory()
    logger.info('%s is converted after %.0f s', name, time.monotonic() - started)
    return network


def stored_folders(cache_dir: str, name: str, identity: Sequence[str], beside: Path | None
                   ) -> Iterator[Path]:
    """Yield the folders that hold a converted network: in the cache, and beside its weights."""
    for root in (resolve_cache_dir(cache_dir), *([beside.parent] if beside else [])):
        folder = network_folder(root, name, identity)
        if folder.exists():
            yield folder


def stored_about(folder: Path) -> dict[str, Any]:
    """Return what the user of a stored network needs; empty where the file is damaged."""
    try:
        return dict(parse_json(read_file(folder / ABOUT))['about'])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return {}


def stored_identity(folder: Path) -> list[str]:
    """Return the identity of a stored network, whose description is sound."""
    return list(parse_json(read_file(folder / ABOUT))['identity'])


def network_folder(root: Path, name: str, identity: Sequence[str]) -> Path:
    """Return the folder of a converted network in a cache."""
    digest = hashlib.sha256(json.dumps([str(_FORMAT), *identity]).encode()).hexdigest()
    return root / 'openvino' / f'{Path(name).name}-{digest[:32]}'


def store_network(folder: Path, identity: Sequence[str], conversion: Conversion,
                  precisions: Precisions = FP32, in_half: bool = False) -> Network:
    """Write a network to the cache; return it with its weights mapped from the file.

    In half precision, the file has half the size and the network runs in fp32 nevertheless.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    remove_unused([one for one in folder.parent.iterdir() if not one.name.startswith('.')],
                  folder.parent.glob('.*.tmp'), _MOST_NETWORKS - 1)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix='.', suffix='.tmp',
                                     ignore_cleanup_errors=True) as desk:
        whole = Path(desk) / folder.name
        whole.mkdir()
        import_openvino().save_model(conversion.network, whole / _XML, compress_to_fp16=in_half)
        arrays: dict[str, Any] = {'probe': conversion.probe, 'expected': conversion.expected,
                                  **conversion.arrays}
        np.savez(whole / _PROBE, **arrays)
        prints = {name: fingerprint_file(whole / name) for name in (_XML, _WEIGHTS, _PROBE)}
        (whole / ABOUT).write_text(json.dumps(
            {'identity': list(identity), 'files': prints, 'about': conversion.about}))
        for file in whole.iterdir():
            with file.open('rb+') as opened:
                os.fsync(opened.fileno())
        network = open_stored(whole, precisions, identity)
        if folder.exists():  # damaged, or of another process
            folder.rename(Path(desk) / 'old')
        whole.rename(folder)
    return network


def open_stored(folder: Path, precisions: Precisions = FP32, identity: Sequence[str] = ()
                ) -> Network:
    """Return the network in a folder; raise ValueError and others where it is not sound.

    Without an identity, that of the folder is taken.
    """
    stored = parse_json(read_file(folder / ABOUT))
    if identity and stored['identity'] != list(identity):
        raise ValueError('it belongs to another network')
    for name in (_XML, _WEIGHTS, _PROBE):
        if fingerprint_file(folder / name) != stored['files'][name]:
            raise ValueError(f'{name} is damaged')
    with np.load(folder / _PROBE, allow_pickle=False) as file:
        arrays = dict(file)
    read = import_openvino().Core().read_model(folder / _XML)
    network = _checked(Conversion(read, arrays.pop('probe'), arrays.pop('expected'),
                                  stored['about'], arrays), precisions)
    release_pages(folder / _WEIGHTS)
    return network


def release_pages(file: Path) -> None:
    """Release the memory of a mapped file; the system reads again what is used again.

    The CPU's kernels have copies of the weights in layouts of their own, and read the file only
    while they are compiled.
    """
    madvise = getattr(ctypes.CDLL(None), 'madvise', None)
    if madvise is None:
        return
    # OpenVINO maps the file before its folder gets its name: look for the file itself.
    inode = str(file.stat().st_ino)
    with contextlib.suppress(OSError):  # only Linux has it
        for line in Path('/proc/self/maps').read_text().splitlines():
            fields = line.split(maxsplit=5)
            if fields[4] == inode and fields[-1].endswith(file.name):
                start, end = (int(bound, 16) for bound in fields[0].split('-'))
                madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _MADV_DONTNEED)


def _checked(conversion: Conversion, precisions: Precisions) -> Network:
    """Return a network that gives PyTorch's output; raise ValueError where none does."""
    expected = conversion.expected
    for precision, tolerance in precisions:
        network = Network(conversion.network, conversion.about, precision, conversion.arrays)
        found = network(conversion.probe)
        if found.shape != expected.shape:
            raise ValueError(f'its output has the shape {found.shape}, not {expected.shape}')
        rows = len(expected)
        off = float(np.max(np.linalg.norm((found - expected).reshape(rows, -1), axis=1)
                           / np.linalg.norm(expected.reshape(rows, -1), axis=1)))
        if off <= tolerance:  # false of NaN
            return network
    raise ValueError(f'its output is off by {off:.2g} of its length, not by {tolerance:g} at most')


def convert_module(module: 'torch.nn.Module', example: 'torch.Tensor',
                   shape: Sequence[int]) -> Any:
    """Return an openvino.Model of a PyTorch module on a CPU, in evaluation mode.

    The example is an input to trace the module with. The shape is that of the inputs to come; -1
    stands for a size that may vary.
    """
    import torch

    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # OpenVINO has no such operation
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter('ignore')  # of constants in the trace; the probe tests them
            traced = torch.jit.trace(module, example, strict=False, check_trace=False)
            return import_openvino().convert_model(traced, example_input=example,
                                                   input=[list(shape)])
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
