# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure whether the tests detect faults: ``python test/mutants.py --help``.

Faults are planted in random lines, one at a time and in memory: a comparison is reversed, a
constant changed, a term dropped, a sign flipped, a condition negated, two arguments swapped, a
call removed, or None returned. At least one test that runs the line has to fail; fast tests run
first.

``record`` runs the tests once, and stores their times and the lines that each test runs. A line
that runs on import gets the tests of the lines that use its names. The lines of compiled kernels
cannot be traced. ``record --plain`` therefore runs tests with uncompiled kernels, which are slow
and divide differently; it excludes tests that then fail or take too long. A fault in a kernel runs
those tests with the kernel as plain Python.

If a test that detects a fault also fails without it, the detection does not count and the test is
excluded.
"""

import argparse
import ast
import copy
import gc
import multiprocessing
import os
import pickle
import random
import re
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.machinery import SourceFileLoader
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import pytest
from _pytest.runner import runtestprotocol

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT))  # not the copy in install/

from cliploc_ros.command import run_command  # noqa: E402

PACKAGE = 'cliploc_ros'
RECORDS = PROJECT / 'build' / 'mutants'
_SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or,
    ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}
_QUIET = ('-q', '-x', '-p', 'no:cacheprovider', '-p', 'no:rerunfailures', '-p', 'no:xdist')
# Calls whose arguments may be swapped, or for which a type checker would reject the swap.
_ALIKE = re.compile(r'(^|\.)(max|min|maximum|minimum|hypot|logaddexp|isinstance|cast)$')
_FORK = multiprocessing.get_context('fork')
_LOGS = re.compile(r'(self\._?)?([\w.]+\.get_)?log(ger)?(\(\))?\.(debug|info|warning|error)\(')
# Additional time of a test with a fault, and time of all tests of a fault [s].
_PATIENCE_S, _MOST_S = 60.0, 20.0


class Record(NamedTuple):
    """The processor time of a test, and the lines that it ran."""

    seconds: float  #: Processor time of this process [s]
    lines: frozenset[tuple[str, int]]  #: File, relative to the project, and line


class Mutant(NamedTuple):
    """A fault in a line."""

    file: str
    line: int
    number: int  #: Number of the fault in its file
    what: str
    lines: tuple[int, ...]  #: Lines of its statement; a test that runs one of them runs it
    names: tuple[str, ...]  #: Names that the statement defines, if it runs on import
    function: tuple[str, int] | None  #: Name and first line of the outermost function around it
    is_compiled: bool  #: Whether numba compiles it


class Outcome(NamedTuple):
    """The result of the tests for a fault."""

    mutant: Mutant
    tests: int  #: Number of tests that could detect it
    killer: str = ''  #: The test that detected it, or 'time' if a test did not end


# ---- faults -------------------------------------------------------------------------------------

def mutants_of(file: str) -> list[Mutant]:
    """Return all faults of a file of the project."""
    tree = ast.parse((PROJECT / file).read_text())
    return [site.as_mutant(file, number) for number, site in enumerate(_sites(tree))]


def planted(mutant: Mutant) -> tuple[CodeType, str]:
    """Return the code of a module with a fault, and its changed line."""
    tree = ast.parse((PROJECT / mutant.file).read_text())
    site = _sites(tree)[mutant.number]
    site.put()
    return (compile(ast.fix_missing_locations(tree), str(PROJECT / mutant.file), 'exec'),
            ast.unparse(site.statement).splitlines()[0])


class _Site(NamedTuple):
    """A node of a syntax tree, and its replacement by a fault."""

    parent: ast.AST
    field: str
    row: int | None
    node: Any
    what: str
    new: ast.AST
    statement: ast.stmt
    function: ast.FunctionDef | None  #: The outermost one around it

    def put(self) -> None:
        """Plant the fault."""
        new = ast.copy_location(self.new, self.node)
        if self.row is None:
            setattr(self.parent, self.field, new)
        else:
            getattr(self.parent, self.field)[self.row] = new

    def as_mutant(self, file: str, number: int) -> Mutant:
        one = self.statement
        body = getattr(one, 'body', None)  # for a compound statement only the head counts
        last = body[0].lineno - 1 if body else one.end_lineno or one.lineno
        names: tuple[str, ...] = ()
        if self.function is None:
            names = (one.name,) if isinstance(one, ast.FunctionDef) else tuple(
                node.id for node in ast.walk(one)
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
        decorators = self.function.decorator_list if self.function else []
        return Mutant(
            file, self.node.lineno, number, self.what,
            tuple(range(one.lineno, max(one.lineno, last) + 1)), names,
            None if self.function is None else (self.function.name, min(
                [self.function.lineno, *(each.lineno for each in decorators)])),
            any(isinstance(each, ast.Name) and each.id == 'compiled' for each in decorators))


def _sites(tree: ast.Module) -> list[_Site]:
    return list(_walk(tree, None, None))


def _walk(parent: ast.AST, statement: ast.stmt | None, function: ast.FunctionDef | None
          ) -> Iterator[_Site]:
    """Yield the sites below a node. Annotations, messages, logs and docstrings have none."""
    for field, value in ast.iter_fields(parent):
        if field in ('annotation', 'returns', 'decorator_list', 'type_params', 'type_comment'):
            continue
        around = function
        if function is None and field == 'body' and isinstance(parent, ast.FunctionDef):
            around = parent
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or isinstance(
                    node, (ast.JoinedStr, ast.Raise, ast.Assert, ast.Import, ast.ImportFrom)):
                continue
            if isinstance(node, ast.Expr) and (isinstance(node.value, ast.Constant)
                                               or _LOGS.match(ast.unparse(node))):
                continue
            within = node if isinstance(node, ast.stmt) else statement
            for what, new in _changes(node, parent, field):
                assert within is not None
                yield _Site(parent, field, index if isinstance(value, list) else None, node, what,
                            new, within, around)
            yield from _walk(node, within, around)


def _changes(node: ast.AST, parent: ast.AST, field: str) -> Iterator[tuple[str, ast.AST]]:
    """Yield the faulty replacements of a node."""
    if field == 'test' and isinstance(parent, (ast.If, ast.While, ast.IfExp)):
        yield 'condition negated', ast.UnaryOp(ast.Not(), copy.deepcopy(node))  # type: ignore
    yield from _changes_of_statement(node)
    match node:
        case ast.Compare(ops=[op]) if type(op) in _SWAPPED and field != 'test':
            yield 'comparison turned', _with(node, ops=[_SWAPPED[type(op)]()])
        case ast.BinOp(left=left, op=op, right=right):
            if type(op) in _SWAPPED:
                yield 'operation exchanged', _with(node, op=_SWAPPED[type(op)]())
                yield 'second term dropped', left
            if isinstance(op, ast.MatMult):
                yield 'factors exchanged', _with(node, left=right, right=left)
        case ast.BoolOp(op=op, values=values):
            yield 'and, or exchanged', _with(node, op=_SWAPPED[type(op)]())
            yield 'last condition dropped', (
                values[0] if len(values) == 2 else _with(node, values=values[:-1]))
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield 'sign or not dropped', operand
        case ast.Constant(value=bool() as value):
            yield f'{value} exchanged', ast.Constant(not value)
        case ast.Constant(value=int() as value):
            yield f'{value} is {value + 1}', ast.Constant(value + 1)
        case ast.Constant(value=float() as value):
            yield f'{value} is {1.3 * value or 1.0:g}', ast.Constant(1.3 * value or 1.0)
        case ast.Call(args=[first, second, *others], func=function) if not any(
                isinstance(argument, ast.Starred) for argument in node.args) and not _ALIKE.search(
                ast.unparse(function)):
            yield 'arguments exchanged', _with(node, args=[second, first, *others])


def _changes_of_statement(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.Return(value=ast.expr() as value) if not (
                isinstance(value, ast.Constant) and value.value is None):
            yield 'None returned', ast.Return(ast.Constant(None))
        case ast.Expr(value=ast.Call()) | ast.AugAssign():
            yield 'statement left out', ast.Pass()
        case ast.Continue():
            yield 'break', ast.Break()
        case ast.Break():
            yield 'continue', ast.Continue()


def _with(node: ast.AST, **fields: Any) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def draw(folders: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Draw faults in lines of some folders of the package at random, one per line."""
    by_line = defaultdict(list)
    for folder in folders:
        for path in sorted((PROJECT / PACKAGE / folder).rglob('*.py')):
            for mutant in mutants_of(str(path.relative_to(PROJECT))):
                by_line[mutant.file, mutant.line].append(mutant)
    rng = random.Random(seed)
    lines = rng.sample(sorted(by_line), min(count, len(by_line)))
    return [rng.choice(by_line[line]) for line in lines]


# ---- the lines of tests -------------------------------------------------------------------------

class Recorder:
    """A pytest plugin that records the lines of the package that each test runs.

    Lines of a fixture that several tests share count for each of them.
    """

    def __init__(self, most_s: float) -> None:
        self.records: dict[str, Record] = {}
        self._most_s = most_s
        self._lines: set[tuple[str, int]] = set()
        self._of_fixtures: dict[str, set[tuple[str, int]]] = defaultdict(set)
        self._failed = False
        monitoring = sys.monitoring
        monitoring.use_tool_id(monitoring.PROFILER_ID, 'mutants')
        monitoring.register_callback(monitoring.PROFILER_ID, monitoring.events.LINE, self._run)
        monitoring.set_events(monitoring.PROFILER_ID, monitoring.events.LINE)

    def _run(self, code: CodeType, line: int) -> object:
        if code.co_filename.startswith(f'{PROJECT}/{PACKAGE}/'):
            self._lines.add((code.co_filename.removeprefix(f'{PROJECT}/'), line))
        return sys.monitoring.DISABLE

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Record the lines of a shared fixture."""
        if fixturedef.scope == 'function':
            return (yield)
        before, self._lines = self._lines, set()
        sys.monitoring.restart_events()
        try:
            return (yield)
        finally:
            self._of_fixtures[fixturedef.argname] |= self._lines
            self._lines |= before
            sys.monitoring.restart_events()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Record the lines of a test that passes."""
        self._lines, self._failed, start = set(), False, time.process_time()
        sys.monitoring.restart_events()
        if self._most_s:
            signal.signal(signal.SIGVTALRM, _end_test)
            signal.setitimer(signal.ITIMER_VIRTUAL, self._most_s)
        result = yield
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        if not self._failed:
            shared = (self._of_fixtures.get(name, set()) for name in item.fixturenames)
            self.records[item.nodeid] = Record(time.process_time() - start,
                                               frozenset(self._lines.union(*shared)))
        return result

    def pytest_sessionfinish(self) -> None:
        """Note no more lines."""
        sys.monitoring.free_tool_id(sys.monitoring.PROFILER_ID)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a failure."""
        self._failed |= not report.passed


def _end_test(*_: object) -> None:
    raise TimeoutError('the test takes too long')


def _plain_kernels() -> None:
    """Disable the compilation of kernels, before they are imported."""
    from cliploc_ros.core.kernels import compiled

    compiled.compiled = lambda function: function  # type: ignore[assignment]


def record(arguments: argparse.Namespace) -> int:
    """Run tests, and add their lines to the records."""
    if arguments.plain:
        _plain_kernels()
    recorder = Recorder(arguments.plain)
    code = pytest.main([*_QUIET[:1], *_QUIET[2:], *arguments.tests], [recorder])
    kind = 'plain' if arguments.plain else 'compiled'
    _write(kind, _read(kind) | recorder.records)
    print(f'{len(recorder.records)} tests, {len(_read(kind))} in all, kernels {kind}')
    return int(code) if not arguments.plain else 0


def _read(kind: str) -> dict[str, Record]:
    file = RECORDS / f'{kind}.pickle'
    return pickle.loads(file.read_bytes()) if file.exists() else {}


def _write(kind: str, value: object) -> None:
    RECORDS.mkdir(parents=True, exist_ok=True)
    (RECORDS / f'{kind}.pickle').write_bytes(pickle.dumps(value))


# ---- tests against faults -----------------------------------------------------------------------

class Tests:
    """The recorded tests, by the lines that they run."""

    def __init__(self, kind: str) -> None:
        self.records = _read(kind)
        self._of_line: dict[tuple[str, int], set[str]] = defaultdict(set)
        for name, one in self.records.items():
            for line in one.lines:
                self._of_line[line].add(name)

    def of(self, mutant: Mutant) -> list[str]:
        """Return the tests that can detect a fault, within the time limit.

        Files whose tests run the fewest lines come first, since they are the most specific.
        """
        lines = [(mutant.file, line) for line in mutant.lines]
        if mutant.names:
            word = re.compile(rf'\b({"|".join(mutant.names)})\b')
            lines = [(file, number) for file, text in _sources() for number, line in text
                     if word.search(line)]
        found = set[str]().union(*(self._of_line.get(line, set()) for line in lines))
        by_file = defaultdict(list)
        for name in found:
            by_file[name.split('::')[0]].append(name)
        files = sorted(by_file.values(), key=lambda names: median(
            len(self.records[name].lines) for name in names))
        chosen: list[str] = []
        left = _MOST_S
        for name in (name for names in files for name in sorted(names, key=self.seconds)):
            left -= self.seconds(name) + 0.01
            if left > 0.0 or not chosen:
                chosen.append(name)
        return chosen

    def seconds(self, name: str) -> float:
        """Return the time of a test."""
        return self.records[name].seconds


@cache
def _sources() -> list[tuple[str, list[tuple[int, str]]]]:
    return [(str(path.relative_to(PROJECT)), list(enumerate(path.read_text().splitlines(), 1)))
            for path in sorted((PROJECT / PACKAGE).rglob('*.py'))]


class Judge:
    """Tries faults, each in a child of this process.

    Faults in functions are tried with tests that are already collected: as a pytest plugin, this
    replaces the loop over the tests. A fault in a line that runs on import needs a new pytest.
    """

    def __init__(self, mutants: Sequence[Mutant], tests: Tests, workers: int) -> None:
        self.outcomes: list[Outcome] = []
        self._parts = [mutants[number::workers] for number in range(workers)]
        self._tests = tests
        self._is_sound: dict[str, bool] = {}
        self._items: dict[str, Any] = {}
        self._functions: dict[tuple[str, str, int], list[FunctionType]] = defaultdict(list)

    def pytest_runtestloop(self, session: Any) -> bool:
        """Run tests against faults instead of running them once."""
        self._items = {item.nodeid: item for item in session.items}
        for one in gc.get_objects():
            if isinstance(one, FunctionType):
                code = one.__code__
                self._functions[code.co_filename, code.co_name, code.co_firstlineno].append(one)
        gc.freeze()  # child processes share unmodified memory
        self.run()
        return True

    def run(self) -> None:
        """Try all faults, distributed over the workers."""
        started = [_start(partial(self._outcomes, part)) for part in self._parts]
        for process in started:
            self.outcomes += _finish(*process)

    def _outcomes(self, mutants: Sequence[Mutant]) -> list[Outcome]:
        return [self._outcome(mutant) for mutant in mutants]

    def _outcome(self, mutant: Mutant) -> Outcome:
        names = [name for name in self._tests.of(mutant)
                 if self._is_sound.get(name, True) and (not self._items or name in self._items)]
        while names:
            killer = self._killer(mutant, names)
            if killer in self._tests.records and killer not in self._is_sound:
                self._is_sound[killer] = not self._killer(None, [killer])
            if self._is_sound.get(killer, True):
                return Outcome(mutant, len(names), killer)
            names.remove(killer)
        return Outcome(mutant, 0)

    def _killer(self, mutant: Mutant | None, names: list[str]) -> str:
        """Return the first test that fails, 'time', an exit code, or ''."""
        allowed = _PATIENCE_S + 4.0 * sum(map(self._tests.seconds, names))
        with tempfile.TemporaryDirectory(prefix='mutant-', ignore_cleanup_errors=True) as folder:
            return str(_finish(*_start(
                lambda: self._try(mutant, names, Path(folder) / 'tmp')), allowed))

    def _try(self, mutant: Mutant | None, names: list[str], folder: Path) -> str:
        """Run tests in this child process; return the first that fails."""
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        if not self._items:
            if mutant is not None:
                _plant_at_import(mutant)
            failures = _Failures()
            code = int(pytest.main([*_QUIET, '--basetemp', str(folder), *names], [failures]))
            return failures.first or (f'exit code {code}' if code else '')
        if mutant is not None:
            self._plant(mutant)
        items = [self._items[name] for name in names]
        items[0].config._tmp_path_factory._basetemp = folder
        folder.mkdir()
        for item, following in pairwise([*items, None]):
            if any(one.failed for one in runtestprotocol(item, log=False, nextitem=following)):
                return str(item.nodeid)
        return ''

    def _plant(self, mutant: Mutant) -> None:
        """Replace the code of a function by the code with a fault."""
        assert mutant.function is not None
        faulty = next(code for code in _codes_of(planted(mutant)[0])
                      if (code.co_name, code.co_firstlineno) == mutant.function)
        for function in self._functions[str(PROJECT / mutant.file), *mutant.function]:
            function.__code__ = faulty


def _start(work: Callable[[], object]) -> tuple[Any, Any]:
    """Start work in a child with its process group; return it and the pipe of its result."""
    here, there = _FORK.Pipe(duplex=False)

    def run() -> None:
        os.setpgid(0, 0)
        there.send(work())

    child = _FORK.Process(target=run)
    child.start()
    there.close()
    return child, here


def _finish(child: Any, here: Any, limit_s: float | None = None) -> Any:
    """Return the result of a child, 'time' or an exit code; end its processes."""
    try:
        result = here.recv() if here.poll(limit_s) else 'time'
    except EOFError:
        child.join()
        result = f'exit code {child.exitcode}'
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.join()
    return result


class _Failures:
    """A pytest plugin that stores the first test that fails."""

    first = ''

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.first = self.first or (report.nodeid if report.failed else '')

    pytest_collectreport = pytest_runtest_logreport


def _plant_at_import(mutant: Mutant) -> None:
    """Load a module that is not imported yet with a fault."""
    code, name = planted(mutant)[0], mutant.file.removesuffix('.py').removesuffix('/__init__')
    get_code = SourceFileLoader.get_code

    def get(self: SourceFileLoader, fullname: str) -> CodeType | None:
        return code if fullname == name.replace('/', '.') else get_code(self, fullname)
    SourceFileLoader.get_code = get  # type: ignore[method-assign,assignment]


def _codes_of(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes_of(constant)


def judge(mutants: Sequence[Mutant], workers: int) -> list[Outcome]:
    """Return the outcome of each fault. Kernels are judged in a separate process."""
    kernels = [mutant for mutant in mutants if mutant.is_compiled]
    outcomes = list(_finish(*_start(lambda: _judge_kernels(kernels, workers))))
    import hypothesis, numba, scipy.optimize, scipy.spatial, scipy.stats, yaml  # noqa: E401,F401,I001

    tests, others = Tests('compiled'), [mutant for mutant in mutants if not mutant.is_compiled]
    at_import = Judge([other for other in others if other.function is None], tests, workers)
    at_import.run()
    return outcomes + at_import.outcomes + _judge_functions(
        [other for other in others if other.function is not None], tests, workers)


def _judge_kernels(mutants: Sequence[Mutant], workers: int) -> list[Outcome]:
    _plain_kernels()
    return _judge_functions(mutants, Tests('plain'), workers)


def _judge_functions(mutants: Sequence[Mutant], tests: Tests, workers: int) -> list[Outcome]:
    judge, files = Judge(mutants, tests, workers), {
        name.split('::')[0] for mutant in mutants for name in tests.of(mutant)}
    if files:
        pytest.main([*_QUIET, '-s', *sorted(files)], [judge])
    return judge.outcomes + [Outcome(mutant, 0) for mutant in mutants if not files]


# ---- the report ---------------------------------------------------------------------------------

def report(outcomes: Sequence[Outcome]) -> str:
    """Return a table by folder, and the faults that no test detected."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for outcome in outcomes:
        folder = str(Path(outcome.mutant.file).parent.relative_to(PACKAGE))
        for row in {folder, f'{folder.split("/")[0]}, all', 'all',
                    'kernels' if outcome.mutant.is_compiled else 'Python'}:
            counts[row]['killed' if outcome.killer else
                        'survived' if outcome.tests else 'not run'] += 1
    text = f'{"folder":28}{"killed":>8}{"survived":>10}{"not run":>9}{"share":>7}\n'
    for row, its in sorted(counts.items()):
        text += (f'{row:28}{its["killed"]:8}{its["survived"]:10}{its["not run"]:9}'
                 f'{its["killed"] / its.total():7.2f}\n')
    return text + '\nno test noticed (tests that run the line):\n' + ''.join(
        f'{outcome.mutant.file}:{outcome.mutant.line}: {outcome.mutant.what} ({outcome.tests}): '
        f'{planted(outcome.mutant)[1]}\n' for outcome in sorted(outcomes) if not outcome.killer)


def run(arguments: argparse.Namespace) -> int:
    """Plant faults, and print the table."""
    mutants = draw(arguments.folders, arguments.count, arguments.seed)
    if arguments.only:
        mutants = [one for one in mutants if arguments.only in f'{one.file}:{one.line}']
    start = time.monotonic()
    outcomes = judge(mutants, arguments.workers)
    _write('outcomes', outcomes)
    text = report(outcomes) + f'\n{len(outcomes)} faults in {time.monotonic() - start:.0f} s'
    (RECORDS / 'report.txt').write_text(text)
    print(text)
    return 0


def main() -> int:
    """Run the program; return its exit code."""
    parser = argparse.ArgumentParser(prog='python test/mutants.py', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(required=True)
    part = parts.add_parser('record', help='record the lines that tests run')
    part.add_argument('tests', nargs=argparse.REMAINDER,
                      help='arguments of pytest, such as test/core')
    part.add_argument('--plain', type=float, default=0.0, metavar='S',
                      help='kernels are not compiled; tests that take longer are left out')
    part.set_defaults(run=record)
    part = parts.add_parser('run', help='plant faults')
    part.add_argument('folders', nargs='+', help='folders of the package, such as core ros/inputs')
    part.add_argument('--seed', type=int, default=0)
    part.add_argument('--count', type=int, default=300)
    part.add_argument('--workers', type=int, default=2)
    part.add_argument('--only', default='', help='only faults in FILE or FILE:LINE')
    part.set_defaults(run=run)
    arguments = parser.parse_args()
    warnings.filterwarnings('ignore', '.*use of fork', DeprecationWarning)
    return run_command(lambda: int(arguments.run(arguments)))


if __name__ == '__main__':
    sys.exit(main())
