# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerical kernels are compiled: one decorator, so that all share its settings."""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel to machine code at its first call, and keep the code on disk.

    The GIL is released while the kernel runs, so that a node answers during a search, and
    divisions by zero give inf and NaN as in NumPy.
    """
    settings = {'nogil': True, 'error_model': 'numpy'}
    try:
        return njit(cache=True, **settings)(function)
    except RuntimeError:
        # Neither the package's folder nor the user's cache can be written: compile each time.
        return njit(**settings)(function)
