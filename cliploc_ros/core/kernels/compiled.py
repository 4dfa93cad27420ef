# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compile numerical kernels, and keep the machine code on disk in the files of numba's cache.

By itself, numba's cache does not notice a change of a kernel that another kernel calls, runs a
damaged file, and reads files of any user. Here, the stamp of a file is a digest of the source of
the kernel's module and of all modules that it imports, its name contains the versions, the code
has a checksum, and the owner of the folder is checked. A file is therefore never outdated, and
machines, users and versions can share a folder.
"""

import hashlib
import logging
import os
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from pickle import loads
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import njit
from numba.core.caching import IndexDataCacheFile, NullCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from cliploc_ros.files.storage import check_owners, resolve_cache_dir, warn_not_kept

_PACKAGE = Path(__file__).resolve().parents[2]
_ROOT = _PACKAGE.name
_IMPORTED = re.compile(rb'^(?:from|import) (%s[\w.]*)(?: import (\w+)$)?' % _ROOT.encode(), re.M)
_VERSIONS = hashlib.sha256(repr((sys.version_info[:2], numba.__version__, llvmlite.__version__,
                                 np.__version__)).encode()).hexdigest()[:8]
#: Zero as an argument of a kernel; a literal 0 would compile a further specialization.
ZERO = np.int64(0)
#: Number of kernels that were 'found' on disk, 'missing' there, and 'not kept' there.
COUNTS: Counter[str] = Counter()

logger = logging.getLogger(__name__)


@cache
def kernel_folder(preferred: Path | None = None) -> Path | None:
    """Return the folder of the kernels; None if other users may have written to it.

    A forged kernel would run arbitrary code. The owner of the package can do that anyway. A new
    folder begins with the kernels that were compiled after the installation.
    """
    own = _PACKAGE / '__pycache__' / 'kernels'
    if given := os.environ.get('NUMBA_CACHE_DIR'):
        folder = Path(given)
    elif preferred is not None:
        folder = preferred
    else:
        is_ours = os.access(own if own.exists() else _PACKAGE, os.W_OK)
        folder = own if is_ours else resolve_cache_dir('') / 'kernels'
    with suppress(OSError):  # reported by the first write
        if not folder.exists() and own.exists():
            shutil.copytree(own, folder)
    try:
        check_owners(folder)
    except PermissionError as error:
        logger.warning('%s is not used: %s', folder, error.strerror)
        return None
    return folder


class KernelCache(NullCache):
    """The compiled versions of one kernel on disk, in the files of numba's cache.

    If a file is damaged or the folder is not writable, the kernel is compiled again.
    """

    folder: Path | None = None  #: See kernel_folder

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel = kernel

    def _files(self) -> IndexDataCacheFile | None:
        folder, function = kernel_folder(KernelCache.folder), self._kernel.py_func
        if folder is None:
            return None
        module = function.__module__
        return IndexDataCacheFile(
            str(folder), f'{module.removeprefix(f"{_ROOT}.")}.{function.__qualname__}-{_VERSIONS}',
            (source_stamp(module), sorted(self._kernel.targetoptions.items())))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for the types of arguments; None if it is not on disk."""
        target_context.refresh()
        if files := self._files():
            try:
                entry = files.load((sig, target_context.codegen().magic_tuple()))
                if entry:
                    if hashlib.sha256(entry[1]).digest() != entry[0]:
                        raise ValueError('wrong checksum')
                    found = CompileResult._rebuild(target_context, *loads(entry[1]))
                    COUNTS['found'] += 1
                    return found
            except Exception as error:  # pickle and LLVM raise many kinds of errors
                logger.warning('%s is damaged (%r): compiling it again', files._index_path, error)
                with suppress(OSError):
                    files.flush()
        COUNTS['missing'] += 1
        if COUNTS['missing'] == 1:
            logger.info('compiling the search for this processor, once after an installation: '
                        'about 20 s of processor time')
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the machine code for the types of arguments."""
        try:
            content = dumps(data._reduce())
        except RuntimeError as error:
            # no code was compiled, because Ctrl-C arrived in a callback of llvmlite, which lost it
            raise KeyboardInterrupt from error
        if files := self._files():
            try:
                Path(files._cache_path).mkdir(parents=True, exist_ok=True)
                files.save((sig, data.codegen.magic_tuple()),
                           (hashlib.sha256(content).digest(), content))
            except Exception as error:  # a full disk may leave an index that pickle cannot read
                COUNTS['not kept'] += 1
                if COUNTS['not kept'] == 1:
                    reason = error.strerror if isinstance(error, OSError) else repr(error)
                    warn_not_kept(f'cannot keep compiled kernels in {files._cache_path}: '
                                  f'{reason}; each start compiles them again; set '
                                  'cache_dir to a folder with room')


@cache
def source_stamp(module: str) -> str:
    """Return a digest of the sources of a module and of all modules of this package it imports."""
    sources, waiting = dict[str, bytes](), [module]
    for name in waiting:
        if name in sys.modules and name not in sources:
            sources[name], imported = _read_source(name)
            if name != __name__:  # no kernel calls what this module imports
                waiting += imported
    return hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()


@cache
def _read_source(module: str) -> tuple[bytes, list[str]]:
    """Return the digest of a module's file, and the names that it imports from this package."""
    source = Path(str(sys.modules[module].__file__)).read_bytes()
    return hashlib.sha256(source).digest(), [
        part.decode() for match in _IMPORTED.finditer(source)
        for part in (match[1], match[1] + b'.' + (match[2] or b''))]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel to machine code at its first call, and cache the code on disk.

    The kernel releases the GIL, so that a node stays responsive during a search. Divisions by zero
    give inf and NaN, as in NumPy.
    """
    # Kernels are not called through C pointers; without the wrapper for that, they compile faster.
    kernel = njit(nogil=True, error_model='numpy', no_cfunc_wrapper=True)(function)
    kernel._cache = KernelCache(kernel)
    return kernel


def warm_up(run: Callable[[], object]) -> None:
    """Call a function that runs the kernels, and log the number and time of those compiled."""
    start, missing = time.monotonic(), COUNTS['missing']
    run()
    if compiled_now := COUNTS['missing'] - missing:
        logger.info('compiled %d kernels in %.1f s; they are kept in %s', compiled_now,
                    time.monotonic() - start,
                    'no folder' if COUNTS['not kept'] else kernel_folder(KernelCache.folder))
