# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerical kernels are compiled: one decorator, so that all share its settings.

Where numba is absent the kernels run as they stand, as plain Python: equal results, hundreds of
times slower.
"""

import functools
import logging
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

try:
    from numba import njit
    from numba.core import config
    from numba.core.caching import NullCache
except ImportError:
    njit = None
else:
    # As newer numba always has it; 0.59 takes a damaged file of a kernel that another one
    # calls for a mistake in that one's types.
    config.CAPTURED_ERRORS = 'new_style'

logger = logging.getLogger(__name__)
_kernels: list[Any] = []
# What numba raises for a cache that was cut off by a power cut.
_DAMAGE = (EOFError, pickle.UnpicklingError)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel to machine code at its first call, and keep the code on disk.

    The GIL is released while the kernel runs, so that a node answers during a search, and
    divisions by zero give inf and NaN as in NumPy.
    """
    if njit is None:
        return _interpreted(function)
    settings = {'nogil': True, 'error_model': 'numpy'}
    try:
        kernel = njit(cache=True, **settings)(function)
    except RuntimeError:
        # Neither the package's folder nor the user's cache can be written: compile each time.
        kernel = njit(**settings)(function)
    _kernels.append(kernel)
    return kernel


def _interpreted(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let a kernel run as plain Python, as silent about infinities as compiled code."""
    @functools.wraps(function)
    def kernel(*args: Any) -> Any:
        with np.errstate(all='ignore'):
            return function(*args)
    return kernel


def warm_up(run: Callable[[], object]) -> None:
    """Run what calls the kernels; mend their cache on disk, or do without it.

    Parameters
    ----------
    run : callable
        Calls every kernel that will be needed.
    """
    for _ in range(len(_kernels) + 1):  # each kernel has a file of its own to be damaged
        try:
            run()
            return
        except _DAMAGE as error:
            logger.warning('cached kernels could not be read: %r; compiling anew', error)
            _forget_cache()
        except OSError as error:  # as on a full disk: every kernel would fail, and each request
            logger.warning('compiled kernels are not cached, so each start will take a minute '
                           'until there is room in their folder or NUMBA_CACHE_DIR names '
                           'another: %s', error)
            _do_without_cache()
    run()


def _do_without_cache() -> None:
    """Let this process neither read nor write kernels on disk."""
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
