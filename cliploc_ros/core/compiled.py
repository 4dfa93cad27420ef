# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerical kernels are compiled: one decorator, so that all share its settings."""

import logging
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core import config
from numba.core.caching import NullCache

# The default of newer versions. In the old style, numba 0.59 reports the damaged cache of a callee
# as a typing error of its caller.
config.CAPTURED_ERRORS = 'new_style'

#: A literal 0 as an argument compiles a further specialization of a kernel; this one does not.
ZERO = np.int64(0)

logger = logging.getLogger(__name__)
_kernels: list[Any] = []
# Raised by numba for a file that is truncated, as after a power cut, and for one that names a
# module or type of another version of this package.
_DAMAGE = (EOFError, pickle.UnpicklingError, ImportError, AttributeError)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel to machine code at its first call, and cache the code on disk.

    The kernel releases the GIL, so that a node answers during a search. Divisions by zero give
    inf and NaN, as in NumPy.
    """
    settings = {'nogil': True, 'error_model': 'numpy'}
    try:
        kernel = njit(cache=True, **settings)(function)
    except RuntimeError:
        # Neither the package's folder nor the user's cache is writable: compile at each start.
        kernel = njit(**settings)(function)
    _kernels.append(kernel)
    return kernel


def warm_up(run: Callable[[], object]) -> None:
    """Run the kernels once; repair their cache on disk, or continue without it.

    Parameters
    ----------
    run : callable
        Calls every kernel that requests use.
    """
    for _ in range(len(_kernels) + 1):  # each kernel has its own file, which may be damaged
        try:
            run()
            return
        except _DAMAGE as error:
            logger.warning('cached kernels are damaged or outdated: %r; compiling them again',
                           error)
            _forget_cache()
        except OSError as error:  # as on a full disk: every kernel and every request would fail
            logger.warning('cannot cache compiled kernels: %s; each start takes a minute until '
                           'NUMBA_CACHE_DIR names a folder with room', error)
            _disable_cache()
    run()


def _disable_cache() -> None:
    """Stop this process from reading and writing kernels on disk."""
    for kernel in _kernels:
        kernel._cache = NullCache()


def _forget_cache() -> None:
    """Delete this package's compiled kernels from disk."""
    for kernel in _kernels:
        folder = kernel.stats.cache_path
        if folder:
            module = Path(kernel.py_func.__code__.co_filename).stem
            for file in Path(folder).glob(f'{module}.*.nb[ic]'):
                with suppress(OSError):
                    file.unlink()
