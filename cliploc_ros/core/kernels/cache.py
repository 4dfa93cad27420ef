# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels on disk, found by what they are compiled from.

numba's own cache knows a kernel by path, line and file. It misses a change of a kernel that
another one calls, and it compiles again after a copy, an upgrade or a change of a comment. Here
the name of a file holds a digest of all that decides the machine code: the bytecode and constants
of the kernel and of those that it calls, the types of the arguments, the processor, and the
versions of Python, numba and NumPy. So a file is never outdated, and machines, users and versions
may share a folder.
"""

import dis
import hashlib
import logging
import os
import pickle
import stat
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.core.types import BaseTuple, Type  # type: ignore[attr-defined]

from cliploc_ros.files.storage import resolve_cache_dir

_PACKAGE = Path(__file__).resolve().parents[2]
_ROOT = _PACKAGE.name
_VERSIONS = (sys.version_info[:2], numba.__version__, llvmlite.__version__, np.__version__)
_DIGEST_BYTES = 32
_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), np.generic)

logger = logging.getLogger(__name__)


class KernelFolders:
    """Where compiled kernels lie: the folders of this process, the preferred one first.

    NUMBA_CACHE_DIR replaces all others.

    Attributes
    ----------
    found, missing : int
        How many kernels were read, and how many were looked for in vain.
    kept_in : Path or None
        Where the last new kernel was stored; None where no folder takes them.
    """

    def __init__(self) -> None:
        self.found = self.missing = 0
        self.kept_in: Path | None = None
        self._preferred: Path | None = None
        self._is_warned = False

    def prefer(self, folder: Path) -> None:
        """Look for kernels in a folder first, and keep them there."""
        self._preferred = folder

    def read(self, name: str) -> bytes | None:
        """Return what is stored under a name, or None."""
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
        """Store content in the first folder that takes it, and remove what the pattern matches."""
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
            logger.warning('cannot keep compiled kernels (%s): each start compiles them again; '
                           'set cache_dir to a folder with room', '; '.join(failures))

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

    @staticmethod
    def _write(file: Path, content: bytes) -> str:
        """Write a file in one step; return what failed, or ''."""
        partial = file.with_name(f'.{file.name}.{os.getpid()}.partial')
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(hashlib.sha256(content).digest() + content)
            partial.replace(file)
        except OSError as error:
            if file.parent.is_dir() and os.access(file.parent, os.W_OK):
                partial.unlink(missing_ok=True)
            return f'{file.parent}: {error.strerror}'
        return ''


KERNEL_FOLDERS = KernelFolders()


class KernelCache(NullCache):
    """The compiled versions of one kernel on disk, in the place of numba's cache.

    A damaged file, or a folder that cannot be written to, costs the time to compile and no more.

    Parameters
    ----------
    kernel : Dispatcher
        What numba made of the function.
    """

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel = kernel
        function = kernel.py_func
        self._name = f'{function.__module__.removeprefix(f"{_ROOT}.")}.{function.__qualname__}'

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for the types of arguments, or None."""
        target_context.refresh()
        name, _ = self._file_names(sig, target_context.codegen())
        content = KERNEL_FOLDERS.read(name)
        if content is None:
            return None
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception as error:  # pickle and LLVM raise many kinds
            logger.warning('a compiled kernel cannot be used (%r): compiling %s again', error,
                           self._name)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code for the types of arguments."""
        if not data.library.has_dynamic_globals:
            name, outdated = self._file_names(sig, data.codegen)
            KERNEL_FOLDERS.store(name, dumps(data._reduce()), outdated)

    def _file_names(self, sig: Any, codegen: Any) -> tuple[str, str]:
        """Return the name of the file, and a pattern of the names it had with other sources."""
        place = _hash((_VERSIONS, codegen.magic_tuple(), [_describe(each) for each in sig]))
        return (f'{self._name}-{place}-{source_stamp(self._kernel)}.kernel',
                f'{self._name}-{place}-*.kernel')


def source_stamp(kernel: Dispatcher) -> str:
    """Return a digest of a kernel's source and of all kernels that it calls, directly or not.

    Raises
    ------
    TypeError
        The kernel uses a global variable of a kind that the digest does not cover.
    """
    found: dict[str, object] = {}
    _collect(kernel, found)
    return _hash((sorted(found.items()), sorted(kernel.targetoptions.items())))


def _collect(kernel: Dispatcher, found: dict[str, object]) -> None:
    """Add a kernel and those that it calls to what was found, by name."""
    name, source, callees = _read_function(kernel.py_func)
    if name not in found:
        found[name] = source
        for each in callees:
            _collect(each, found)


@cache
def _read_function(function: FunctionType) -> tuple[str, object, list[Dispatcher]]:
    """Return a kernel's name, what it is compiled from, and the kernels that it calls."""
    name = f'{function.__module__}.{function.__qualname__}'
    callees = []
    values: list[tuple[object, ...]] = []
    for used in sorted(_global_names(function.__code__) & function.__globals__.keys()):
        value = function.__globals__[used]
        if isinstance(value, Dispatcher):
            callees.append(value)
            values.append((used, value.py_func.__module__, value.py_func.__qualname__))
        else:
            values.append((used, _constant(value, f'{name}: {used}')))
    code = _codes(function.__code__, function.__doc__)
    return name, (code, function.__defaults__, values), callees


def _codes(code: CodeType, doc: str | None = None) -> list[object]:
    """Return bytecode, names and constants of a code object; comments and lines play no part."""
    constants = [_codes(each) if isinstance(each, CodeType) else _constant(each, code.co_name)
                 for each in code.co_consts if doc is None or each != doc]
    return [code.co_code, code.co_names, code.co_varnames, constants]


def _global_names(code: CodeType) -> set[str]:
    names = {each.argval for each in dis.get_instructions(code) if each.opname == 'LOAD_GLOBAL'}
    return names.union(*(_global_names(each) for each in code.co_consts
                         if isinstance(each, CodeType)))


def _constant(value: Any, where: str) -> object:
    """Return what identifies a value that a kernel uses."""
    if isinstance(value, ModuleType) and value.__name__.split('.')[0] != _ROOT:
        return value.__name__
    if isinstance(value, type) and issubclass(value, tuple) and hasattr(value, '_fields'):
        return value.__module__, value.__qualname__, value._fields
    if isinstance(value, tuple):
        return type(value).__name__, [_constant(each, where) for each in value]
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, _PLAIN):
        return type(value).__name__, repr(value)
    outside = getattr(value, '__module__', None) or ''
    if isinstance(value, BuiltinFunctionType | FunctionType | type | np.ufunc) and \
            outside.split('.')[0] != _ROOT:
        return outside, value.__name__
    raise TypeError(f'{where}: a kernel cannot use a global {type(value).__name__}; the digest '
                    'of its source does not cover it')


def _describe(kind: Type) -> object:
    """Return what identifies a type of argument; the fields of a named tuple are part of it."""
    if isinstance(kind, BaseTuple):
        named = getattr(kind, 'instance_class', None)
        identity = named and (named.__module__, named.__qualname__, named._fields)
        return type(kind).__name__, identity, [_describe(each) for each in kind.types]
    return str(kind)


def _hash(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:20]


def _read(file: Path) -> bytes | None:
    """Return the content of a file if it is whole, and only trusted users can write to it."""
    try:
        content = file.read_bytes()
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
    """Return whether a user could have written it who owns neither this package nor the process.

    A forged kernel runs code. Who owns the package can run code anyway.
    """
    trusted = {os.getuid(), 0, Path(__file__).stat().st_uid}
    return any(each.stat().st_uid not in trusted or each.stat().st_mode & stat.S_IWOTH
               for each in (file, file.parent))
