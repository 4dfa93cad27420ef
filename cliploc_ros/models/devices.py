# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Device, inference engine, precision and memory of networks."""

import contextlib
import ctypes
import gc
import logging
import os
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cliploc_ros.errors import ModelError, OptionsError

# NVIDIA's driver on a PC, on a Jetson and in WSL; AMD's driver.
_GPU_FILES = ('nvidia[0-9]*', 'nvhost-gpu', 'nvgpu', 'dxg', 'kfd')
PRECISIONS = ('auto', 'fp16', 'fp32')
INFERENCES = ('auto', 'pytorch', 'openvino')

logger = logging.getLogger(__name__)


def check_run(precision: str, inference: str) -> None:
    """Raise an OptionsError for an unknown precision or inference engine."""
    for name, value, known in (('precision', precision, PRECISIONS),
                               ('inference', inference, INFERENCES)):
        if value not in known:
            raise OptionsError(f"{name} '{value}' is not one of {', '.join(known)}")


def has_gpu() -> bool:
    """Return whether the machine may have a GPU for PyTorch, without loading PyTorch."""
    return any(any(Path('/dev').glob(pattern)) for pattern in _GPU_FILES)


def resolve_device(device: str) -> str:
    """Return 'cpu', 'cuda' or 'cuda:N'; 'auto' gives a GPU if there is one.

    PyTorch is loaded only if a GPU is requested, or if 'auto' finds one. OptionsError: the name is
    invalid, or PyTorch does not find the GPU. ModelError: a GPU is requested without PyTorch.
    """
    if not re.fullmatch(r'auto|cpu|cuda(:\d+)?', device):
        raise OptionsError(f"device '{device}' is not one of auto, cpu, cuda, cuda:0, cuda:1 ...")
    if device == 'cpu' or (device == 'auto' and not (has_gpu() and find_spec('torch'))):
        return 'cpu'
    with needs_pytorch(f"device '{device}'"):
        import torch

    if device == 'auto':
        return 'cuda' if torch.cuda.is_available() else 'cpu'
    if int(device.partition(':')[2] or 0) >= torch.cuda.device_count():
        raise OptionsError(f"device '{device}' is missing: torch {torch.__version__} finds "
                           f"{torch.cuda.device_count()} GPUs; set the device to 'auto' or 'cpu'")
    return device


@contextlib.contextmanager
def needs_pytorch(what: str, otherwise: str = '') -> Iterator[None]:
    """Raise a ModelError instead of an import error; ``what`` is the network that needs PyTorch.

    ``otherwise`` is a further remedy, after ONNX networks and PyTorch.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModelError(
            f'{error.name} is not installed, but {what} needs it: name ONNX files instead (a '
            f"published network, or export_network on a machine with the extra 'models'), or "
            f'install that extra (script/setup models){otherwise}, see doc/install.md'
        ) from error


def count_threads() -> int:
    """Return the number of threads for a network: that of PyTorch if it is loaded."""
    torch = sys.modules.get('torch')
    if torch is not None and hasattr(torch, 'get_num_threads'):
        return int(torch.get_num_threads())
    limit = os.environ.get('OMP_NUM_THREADS', '')
    if limit.isdecimal() and int(limit):
        return int(limit)
    siblings = Path('/sys/devices/system/cpu/smt/active')
    is_doubled = siblings.exists() and siblings.read_text().strip() == '1'
    return max(1, len(os.sched_getaffinity(0)) // (2 if is_doubled else 1))


def set_threads(count: int) -> None:
    """Set the number of threads of networks that this process loads later."""
    os.environ['OMP_NUM_THREADS'] = str(count)  # PyTorch reads this on import
    if 'torch' in sys.modules:
        sys.modules['torch'].set_num_threads(count)


def resolve_precision(precision: str, device: str) -> str:
    """Return 'fp16' or 'fp32'; 'auto' means fp16 on a GPU and fp32 on a CPU."""
    if precision == 'auto':
        return 'fp32' if device == 'cpu' else 'fp16'
    return precision


def resolve_inference(inference: str, device: str, precision: str) -> str:
    """Return 'pytorch' or 'openvino'; 'auto' means OpenVINO on a CPU if it is installed.

    The precision is 'fp16' or 'fp32'.

    OptionsError: OpenVINO is requested on a GPU or in fp16, or it is not installed.
    """
    fits = device == 'cpu' and precision == 'fp32'
    if inference == 'pytorch' or (inference == 'auto' and not fits):
        return 'pytorch'
    if not fits:
        raise OptionsError(f"inference 'openvino' needs device 'cpu' and precision 'fp32', not "
                           f"'{device}' and '{precision}'")
    if import_openvino() is not None:
        return 'openvino'
    if inference == 'openvino':
        raise OptionsError("inference 'openvino': OpenVINO is not installed; run "
                           "'pip install openvino', or set inference to 'pytorch'")
    return 'pytorch'


@cache
def import_openvino() -> Any:
    """Import OpenVINO without its telemetry; return None if it is not installed."""
    # If this package can be imported, OpenVINO reports its import and all conversions to Google.
    sys.modules.setdefault('openvino_telemetry', None)  # type: ignore[arg-type]
    try:
        import openvino
    except ImportError as error:
        logger.info('PyTorch runs the networks, at no more than half the speed: OpenVINO is not '
                    "installed (%s); run 'pip install openvino'", error)
        return None
    return openvino


def free_memory() -> None:
    """Return the memory of freed networks to the system."""
    gc.collect()
    torch = sys.modules.get('torch')
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()
    # glibc keeps freed blocks below 32 MB, but other processes of a robot need the memory.
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)
