# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerical kernels are compiled: one decorator, so that all share its settings."""

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from cliploc_ros.core.kernels.cache import KERNEL_FOLDERS, KernelCache

#: A literal 0 as an argument compiles a further specialization of a kernel; this one does not.
ZERO = np.int64(0)

logger = logging.getLogger(__name__)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel to machine code at its first call, and cache the code on disk.

    The kernel releases the GIL, so that a node answers during a search. Divisions by zero give
    inf and NaN, as in NumPy.
    """
    # Nothing calls a kernel through a C pointer: without that wrapper it compiles faster.
    kernel = njit(nogil=True, error_model='numpy', no_cfunc_wrapper=True)(function)
    kernel._cache = KernelCache(kernel)
    return kernel


def warm_up(run: Callable[[], object]) -> None:
    """Run the kernels once. Where they must be compiled, say so and how long it takes.

    Parameters
    ----------
    run : callable
        Calls every kernel that requests use.
    """
    start, missing = time.monotonic(), KERNEL_FOLDERS.missing
    run()
    compiled_now = KERNEL_FOLDERS.missing - missing
    if compiled_now:
        logger.info('compiled %d kernels in %.1f s; they are kept in %s', compiled_now,
                    time.monotonic() - start, KERNEL_FOLDERS.kept_in or 'no folder')
