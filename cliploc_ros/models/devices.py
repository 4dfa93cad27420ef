# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Device, precision and memory of networks."""

import ctypes
import gc
import sys
from typing import TYPE_CHECKING

from cliploc_ros.errors import OptionsError

if TYPE_CHECKING:
    import torch

PRECISIONS = ('auto', 'fp16', 'fp32')


def check_precision(precision: str) -> None:
    """Raise an OptionsError for a precision that is none of PRECISIONS."""
    if precision not in PRECISIONS:
        raise OptionsError(f"precision '{precision}' is none of {', '.join(PRECISIONS)}")


def resolve_device(device: str) -> 'torch.device':
    """Return the torch device for 'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'.

    Raises
    ------
    OptionsError
        For another name, or a GPU that torch does not see.
    """
    import torch

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
    check_precision(precision)
    if precision == 'auto':
        return 'fp16' if device.type == 'cuda' else 'fp32'
    return precision


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
