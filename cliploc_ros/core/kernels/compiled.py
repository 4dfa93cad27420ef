# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compile numerical kernels, and keep the machine code on disk.

numba's cache does not notice a change of a kernel that another kernel calls, compiles again after
the package is copied, and fails on a damaged file. Here, the name of a file contains a digest of
everything that affects the machine code: the source of the kernel's module and of all modules that
it imports, the types of the arguments, the processor, and the versions of Python, numba and NumPy.
A file is therefore never outdated, and machines, users and versions can share a folder.
"""

import hashlib
import logging
import os
import pickle
import re
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import njit
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.core.types import BaseTuple, Type  # type: ignore[attr-defined]

from cliploc_ros.files.storage import (
    MAKE_ROOM,
    NOT_KEPT,
    is_foreign,
    read_file,
    replace_file,
    resolve_cache_dir,
    warn_not_kept,
)

_PACKAGE = Path(__file__).resolve().parents[2]
_ROOT = _PACKAGE.name
_IMPORTED = re.compile(rb'^(?:from|import) (%s[\w.]*)(?: import (\w+)$)?' % _ROOT.encode(), re.M)
_VERSIONS = (sys.version_info[:2], numba.__version__, llvmlite.__version__, np.__version__)
_DIGEST_BYTES = 32
#: Zero as an argument of a kernel; a literal 0 would compile a further specialization.
ZERO = np.int64(0)

logger = logging.getLogger(__name__)


class KernelFolders:
    """The folders of compiled kernels, in the order of preference.

    If the environment variable NUMBA_CACHE_DIR is set, only this folder is used.

    Attributes
    ----------
    found, missing : int
        Number of kernels that were read, and of kernels that were not found.
    kept_in : Path or None
        Folder in which the last new kernel was stored; None if no folder is writable.
    """

    def __init__(self) -> None:
        self.found = self.missing = 0
        self.kept_in: Path | None = None
        self._preferred: Path | None = None
        self._is_warned = False

    def prefer(self, folder: Path) -> None:
        """Use a folder before the others, for reading and for storing kernels."""
        self._preferred = folder

    def read(self, name: str) -> bytes | None:
        """Return the content stored under a name; None if there is none."""
        for number, folder in enumerate(self._all()):
            content = _read(folder / name)
            if content is not None:
                self.found += 1
                if number and self._preferred is not None:
                    self._write(self._preferred / name, content)
                return content
        self.missing += 1
        if self.missing == 1:
            logger.info('compiling the search for this processor, once after an installation: '
                        'about 20 s of processor time')
        return None

    def store(self, name: str, content: bytes, outdated: str) -> None:
        """Store content in the first writable folder, and delete files that match `outdated`."""
        failures = []
        for folder in self._all():
            old = [file for file in folder.glob(outdated) if file.name != name]
            failure = self._write(folder / name, content)
            if not failure:
                self.kept_in = folder
                for file in old:
                    file.unlink(missing_ok=True)
                return
            failures.append(failure)
        if not self._is_warned:
            self._is_warned = True
            warn_not_kept(f'cannot keep compiled kernels ({"; ".join(failures)}): each start '
                          'compiles them again; set cache_dir to a folder with room')

    def _all(self) -> Iterator[Path]:
        given = os.environ.get('NUMBA_CACHE_DIR')
        if given:
            yield Path(given)
            return
        if self._preferred is not None:
            yield self._preferred
        own = _PACKAGE / '__pycache__' / 'kernels'
        yield own
        if not os.access(own if own.exists() else _PACKAGE, os.W_OK):
            yield resolve_cache_dir('') / 'kernels'

    def _write(self, file: Path, content: bytes) -> str:
        """Write a file atomically; return a description of the failure, or ''."""
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(file) as partial:
                partial.write_bytes(hashlib.sha256(content).digest() + content)
        except OSError as error:
            failure = f'{file.parent}: {error.strerror}'
            if file.parent == self._preferred:  # another folder of this machine may be writable
                NOT_KEPT.append(f'compiled kernels are not kept in {failure}; {MAKE_ROOM}')
            return failure
        return ''


KERNEL_FOLDERS = KernelFolders()


class KernelCache(NullCache):
    """The compiled versions of one kernel on disk, which replaces numba's cache.

    If a file is damaged or no folder is writable, the kernel is compiled again.
    """

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel = kernel
        function = kernel.py_func
        self._name = f'{function.__module__.removeprefix(f"{_ROOT}.")}.{function.__qualname__}'

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for the types of arguments; None if it is not on disk."""
        target_context.refresh()
        name, _ = self._file_names(sig, target_context.codegen())
        content = KERNEL_FOLDERS.read(name)
        if content is None:
            return None
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception as error:  # pickle and LLVM raise many kinds of errors
            logger.warning('a compiled kernel cannot be used (%r): compiling %s again', error,
                           self._name)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the machine code for the types of arguments."""
        if data.library.has_dynamic_globals:
            return
        name, outdated = self._file_names(sig, data.codegen)
        try:
            content = dumps(data._reduce())
        except RuntimeError as error:
            # no code was compiled, because Ctrl-C arrived in a callback of llvmlite, which lost it
            raise KeyboardInterrupt from error
        KERNEL_FOLDERS.store(name, content, outdated)

    def _file_names(self, sig: Any, codegen: Any) -> tuple[str, str]:
        """Return the name of the file, and a pattern of its names with other sources."""
        place = _hash((_VERSIONS, codegen.magic_tuple(), [_describe(each) for each in sig]))
        stamp = _hash((source_stamp(self._kernel.py_func.__module__),
                       sorted(self._kernel.targetoptions.items())))
        return (f'{self._name}-{place}-{stamp}.kernel',
                f'{self._name}-{place}-*.kernel')


@cache
def source_stamp(module: str) -> str:
    """Return a digest of the sources of a module and of all modules of this package it imports."""
    sources: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        if (name := waiting.pop()) not in sources:
            sources[name], imported = _read_source(name)
            if name != __name__:  # no kernel calls what this module imports
                waiting += imported
    return _hash(sorted(sources.items()))


@cache
def _read_source(module: str) -> tuple[bytes, list[str]]:
    """Return the digest of a module's file, and the modules of this package that it imports."""
    source = Path(str(sys.modules[module].__file__)).read_bytes()
    names = [part.decode() for match in _IMPORTED.finditer(source)
             for part in (match[1], match[2] and match[1] + b'.' + match[2]) if part]
    return (hashlib.sha256(source).digest(),
            [name for name in names if name in sys.modules and name != module])


def _describe(kind: Type) -> object:
    """Return the identity of an argument's type, including the fields of a named tuple."""
    if isinstance(kind, BaseTuple):
        named = getattr(kind, 'instance_class', None)
        identity = named and (named.__module__, named.__qualname__, named._fields)
        return type(kind).__name__, identity, [_describe(each) for each in kind.types]
    return str(kind)


def _hash(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:20]


def _read(file: Path) -> bytes | None:
    """Return the content of a file; None if it is damaged or untrusted users can write to it."""
    try:
        content = read_file(file)
    except OSError:
        return None
    if _is_foreign(file):
        logger.warning('%s is not used: other users own it or can write to it', file)
        return None
    digest, content = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        logger.warning('%s is damaged: compiling it again', file)
        return None
    return content


def _is_foreign(file: Path) -> bool:
    """Return whether users other than the owners of this package and process may have written it.

    A forged kernel would run arbitrary code. The owner of the package can do that anyway.
    """
    trusted = {os.getuid(), 0, Path(__file__).stat().st_uid}
    return any(is_foreign(each.stat(), trusted) for each in (file, file.parent))


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
    start, missing = time.monotonic(), KERNEL_FOLDERS.missing
    run()
    compiled_now = KERNEL_FOLDERS.missing - missing
    if compiled_now:
        logger.info('compiled %d kernels in %.1f s; they are kept in %s', compiled_now,
                    time.monotonic() - start, KERNEL_FOLDERS.kept_in or 'no folder')
