# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Device, inference engine, precision and memory of networks."""

import ctypes
import gc
import logging
import sys
from functools import cache
from typing import TYPE_CHECKING, Any

from cliploc_ros.errors import ModelError, OptionsError

if TYPE_CHECKING:
    import torch

PRECISIONS = ('auto', 'fp16', 'fp32')
INFERENCES = ('auto', 'pytorch', 'openvino')

logger = logging.getLogger(__name__)


def check_run(precision: str, inference: str) -> None:
    """Raise an OptionsError for a precision or an inference engine that is not known."""
    for name, value, known in (('precision', precision, PRECISIONS),
                               ('inference', inference, INFERENCES)):
        if value not in known:
            raise OptionsError(f"{name} '{value}' is none of {', '.join(known)}")


def resolve_device(device: str) -> 'torch.device':
    """Return the torch device for 'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'.

    OptionsError: for another name, or a GPU that torch does not see. ModelError: where PyTorch is
    not installed.
    """
    try:
        import torch
    except ModuleNotFoundError as error:
        raise ModelError(f'{error.name} is not installed: detector and CLIP need it; pip install '
                         "the extra 'models', see doc/install.md") from error

    if device == 'auto':
        device = 'cuda' if torch.cuda.is_available() else 'cpu'
    try:
        resolved = torch.device(device)
    except RuntimeError:
        resolved = None
    if resolved is None or resolved.type not in ('cpu', 'cuda'):
        raise OptionsError(f"device '{device}' is none of auto, cpu, cuda, cuda:0, cuda:1 ...")
    if resolved.type == 'cuda' and (resolved.index or 0) >= torch.cuda.device_count():
        raise OptionsError(f"device '{device}' is missing: torch {torch.__version__} sees "
                           f"{torch.cuda.device_count()} GPUs; set the device to 'auto' or 'cpu'")
    return resolved


def resolve_precision(precision: str, device: 'torch.device') -> str:
    """Return 'fp16' or 'fp32'; 'auto' means fp16 on a GPU and fp32 on a CPU."""
    if precision == 'auto':
        return 'fp16' if device.type == 'cuda' else 'fp32'
    return precision


def resolve_inference(inference: str, device: 'torch.device', precision: str) -> str:
    """Return 'pytorch' or 'openvino'; 'auto' means OpenVINO on a CPU, where it is installed.

    The precision is 'fp16' or 'fp32'.

    OptionsError: when OpenVINO is required on a GPU, in fp16, or where it is not installed.
    """
    fits = device.type == 'cpu' and precision == 'fp32'
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
    """Import OpenVINO without its reports to the network; return None where it is missing."""
    # It reports its import and every conversion to Google if this package can be imported.
    sys.modules.setdefault('openvino_telemetry', None)  # type: ignore[arg-type]
    try:
        import openvino
    except ImportError as error:
        logger.info('PyTorch runs the networks, at half the speed or less: OpenVINO is not '
                    "installed (%s); run 'pip install openvino'", error)
        return None
    return openvino


def free_memory() -> None:
    """Return the memory of freed networks to the system."""
    gc.collect()
    torch = sys.modules.get('torch')  # not loaded, it holds nothing
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()
    # glibc keeps freed blocks below 32 MB for later; other processes of a robot need them now.
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)
