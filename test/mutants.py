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

Each fault has a pytest of its own, which loads this file as a plugin. If a test that detects a
fault also fails without it, the detection does not count and the test is excluded.
"""

import argparse
import ast
import copy
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import coverage
import pytest

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
_LOGS = re.compile(r'(self\._?)?([\w.]+\.get_)?log(ger)?(\(\))?\.(debug|info|warning|error)\(')
# Additional time of a test with a fault, and time of all tests of a fault [s].
_PATIENCE_S, _MOST_S = 60.0, 20.0
# For the plugin: the fault as FILE:NUMBER, or '' for none; its kernels, plain or compiled.
_FAULT, _KERNELS = 'MUTANT', 'MUTANT_KERNELS'


class Mutant(NamedTuple):
    """A fault in a line."""

    file: str
    number: int  #: Number of the fault in its file
    what: str
    lines: range  #: Lines of its statement; a test that runs one of them runs it
    names: tuple[str, ...]  #: Names that the statement defines, if it runs on import
    kernels: str  #: Its tests run with 'plain' kernels if numba compiles it, else 'compiled'


# ---- faults -------------------------------------------------------------------------------------

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

    def as_mutant(self, file: str, number: int) -> Mutant:
        one, around = self.statement, self.function
        body = getattr(one, 'body', None)  # for a compound statement only the head counts
        last = body[0].lineno - 1 if body else one.end_lineno or one.lineno
        names: tuple[str, ...] = ()
        if around is None:
            names = (one.name,) if isinstance(one, ast.FunctionDef) else tuple(
                node.id for node in ast.walk(one)
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
        is_compiled = around is not None and any(
            isinstance(each, ast.Name) and each.id == 'compiled' for each in around.decorator_list)
        return Mutant(file, number, self.what, range(one.lineno, max(one.lineno, last) + 1), names,
                      'plain' if is_compiled else 'compiled')


def _sites_of(file: str) -> tuple[ast.Module, list[_Site]]:
    tree = ast.parse((PROJECT / file).read_text())
    return tree, list(_walk(tree, None, None))


def planted(mutant: tuple[str, int]) -> tuple[CodeType, str]:
    """Return the code of a file with a fault, given by its number, and the changed line."""
    tree, sites = _sites_of(mutant[0])
    site = sites[mutant[1]]
    new = ast.copy_location(site.new, site.node)
    if site.row is None:
        setattr(site.parent, site.field, new)
    else:
        getattr(site.parent, site.field)[site.row] = new
    return (compile(ast.fix_missing_locations(tree), str(PROJECT / mutant[0]), 'exec'),
            ast.unparse(site.statement).splitlines()[0])


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


def _changes(node: ast.AST, parent: ast.AST, field: str  # noqa: C901
             ) -> Iterator[tuple[str, ast.AST]]:
    """Yield the faulty replacements of a node."""
    if field == 'test' and isinstance(parent, (ast.If, ast.While, ast.IfExp)):
        yield 'condition negated', ast.UnaryOp(ast.Not(), copy.deepcopy(node))  # type: ignore
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
        case ast.Call(args=[first, second, *others], func=called) if not any(
                isinstance(argument, ast.Starred) for argument in node.args) and not _ALIKE.search(
                ast.unparse(called)):
            yield 'arguments exchanged', _with(node, args=[second, first, *others])


def _with(node: ast.AST, **fields: Any) -> ast.AST:
    changed = copy.copy(node)
    vars(changed).update(fields)
    return changed


def draw(folders: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Draw faults in lines of some folders of the package at random, one per line."""
    by_line = defaultdict(list)
    for folder in folders:
        for path in sorted((PROJECT / PACKAGE / folder).rglob('*.py')):
            file = str(path.relative_to(PROJECT))
            for number, site in enumerate(_sites_of(file)[1]):
                by_line[file, site.node.lineno].append(site.as_mutant(file, number))
    rng = random.Random(seed)
    return [rng.choice(by_line[line])
            for line in rng.sample(sorted(by_line), min(count, len(by_line)))]


# ---- the plugin of pytest -----------------------------------------------------------------------

class Recorder:
    """Records the time of each test, and the lines of the package that it runs.

    Lines of a fixture that several tests share are a context of their own.
    """

    def __init__(self, measured: coverage.Coverage, most_s: float) -> None:
        self.tests: dict[str, tuple[float, list[str]]] = {}
        self._measured, self._most_s, self._test, self._failed = measured, most_s, '', False

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Record the lines of a shared fixture."""
        if fixturedef.scope != 'function':
            self._measured.switch_context(f'fixture {fixturedef.argname}')
        try:
            return (yield)
        finally:
            self._measured.switch_context(self._test)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Record the lines of a test that passes."""
        self._test, self._failed, start = item.nodeid, False, time.process_time()
        self._measured.switch_context(item.nodeid)
        if self._most_s:
            signal.signal(signal.SIGVTALRM, _end_test)
            signal.setitimer(signal.ITIMER_VIRTUAL, self._most_s)
        result = yield
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        if not self._failed:
            self.tests[item.nodeid] = time.process_time() - start, list(item.fixturenames)
        return result

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a failure."""
        self._failed |= not report.passed


def _end_test(*_: object) -> None:
    raise TimeoutError('the test takes too long')


def _plant(fault: str) -> None:
    """Load a module that is not imported yet with a fault, FILE:NUMBER."""
    file, number = fault.split(':')
    code, name = planted((file, int(number)))[0], file.removesuffix('.py').replace('/', '.')
    get_code = SourceFileLoader.get_code

    def get(self: SourceFileLoader, fullname: str) -> CodeType | None:
        return code if fullname == name.removesuffix('.__init__') else get_code(self, fullname)
    SourceFileLoader.get_code = get  # type: ignore[method-assign,assignment]


def _plain_kernels() -> None:
    """Disable the compilation of kernels, before they are imported."""
    from cliploc_ros.core.kernels import compiled

    compiled.compiled = lambda function: function  # type: ignore[assignment]


if os.environ.get(_FAULT):
    _plant(os.environ[_FAULT])
if os.environ.get(_KERNELS) == 'plain':
    _plain_kernels()


def record(arguments: argparse.Namespace) -> None:
    """Run tests, and add their lines to the records."""
    kernels = 'plain' if arguments.plain else 'compiled'
    RECORDS.mkdir(parents=True, exist_ok=True)
    file = RECORDS / f'{kernels}.json'
    tests = json.loads(file.read_text()) if file.exists() else {}
    measured = coverage.Coverage(file.with_suffix('.coverage'), source=[str(PROJECT / PACKAGE)],
                                 config_file=False)
    if tests:
        measured.load()
    if arguments.plain:
        _plain_kernels()
    recorder = Recorder(measured, arguments.plain)
    measured.start()
    pytest.main([_QUIET[0], *_QUIET[2:], *arguments.tests], [recorder])
    measured.stop()
    measured.save()
    file.write_text(json.dumps(tests | recorder.tests))
    print(f'{len(recorder.tests)} tests, {len(tests | recorder.tests)} in all, kernels {kernels}')


# ---- tests against faults -----------------------------------------------------------------------

class Tests:
    """The recorded tests, by the lines that they run."""

    def __init__(self, kernels: str) -> None:
        file = RECORDS / f'{kernels}.json'
        self._tests: dict[str, tuple[float, list[str]]] = json.loads(
            file.read_text() if file.exists() else '{}')
        self._lines = coverage.CoverageData(str(file.with_suffix('.coverage')))
        self._lines.read()
        self._by_file = cache(self._lines.contexts_by_lineno)
        self._kernels, self._is_sound = kernels, dict[str, bool]()

    def of(self, mutant: Mutant) -> list[str]:
        """Return the tests that can detect a fault, fast ones first, within the time limit."""
        lines = {mutant.file: set(mutant.lines)}
        if mutant.names:
            word = re.compile(rf'\b({"|".join(mutant.names)})\b')
            lines = {file: {number for number, line in enumerate(text, 1) if word.search(line)}
                     for file, text in _sources().items()}
        found = {context for file, numbers in lines.items()
                 for number, contexts in self._by_file(str(PROJECT / file)).items()
                 if number in numbers for context in contexts}
        fixtures = {context.removeprefix('fixture ') for context in found - self._tests.keys()}
        names = sorted((name for name, (_, used) in self._tests.items()
                        if name in found or fixtures & set(used)), key=self.seconds)
        chosen, left = names[:1], _MOST_S
        for name in names[1:]:
            left -= self.seconds(name) + 0.01
            if left > 0.0:
                chosen.append(name)
        return chosen

    def seconds(self, name: str) -> float:
        """Return the time of a test."""
        return self._tests[name][0]

    def killer(self, fault: str, names: Sequence[str]) -> str:
        """Return the first test that fails with a fault, 'time' or an exit code; '' if none."""
        environment = os.environ | {
            _FAULT: fault, _KERNELS: self._kernels, 'PYTHONPATH': os.pathsep.join(
                [str(Path(__file__).parent), os.environ.get('PYTHONPATH', '')])}
        with tempfile.TemporaryDirectory(prefix='mutant-', ignore_cleanup_errors=True) as folder:
            process = subprocess.Popen(
                [sys.executable, '-m', 'pytest', *_QUIET, '-p', 'mutants', '--basetemp',
                 f'{folder}/tmp', *names], cwd=PROJECT, env=environment, text=True,
                start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
            try:
                output, _ = process.communicate(
                    timeout=_PATIENCE_S + 4.0 * sum(map(self.seconds, names)))
            except subprocess.TimeoutExpired:
                return 'time'
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        failed = re.search(r'^(?:FAILED|ERROR) (\S+\.py.*?)(?: - |$)', output, re.MULTILINE)
        if process.returncode and not failed:
            return f'exit code {process.returncode}'
        return failed[1] if failed else ''

    def outcome(self, mutant: Mutant) -> tuple[Mutant, int, str]:
        """Return a fault, the number of tests that could detect it, and the test that did."""
        names = [name for name in self.of(mutant) if self._is_sound.get(name, True)]
        while names:
            killer = self.killer(f'{mutant.file}:{mutant.number}', names)
            if killer in names and killer not in self._is_sound:
                self._is_sound[killer] = not self.killer('', [killer])
            if self._is_sound.get(killer, True):
                return mutant, len(names), killer
            names.remove(killer)
        return mutant, 0, ''


@cache
def _sources() -> Mapping[str, list[str]]:
    return {str(path.relative_to(PROJECT)): path.read_text().splitlines()
            for path in sorted((PROJECT / PACKAGE).rglob('*.py'))}


def report(outcomes: Sequence[tuple[Mutant, int, str]]) -> str:
    """Return a table by folder, and the faults that no test detected."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant, tests, killer in outcomes:
        for row in str(Path(mutant.file).parent.relative_to(PACKAGE)), mutant.kernels, 'all':
            counts[row]['killed' if killer else 'survived' if tests else 'not run'] += 1
    text = f'{"folder":28}{"killed":>8}{"survived":>10}{"not run":>9}{"share":>7}\n'
    for row, its in sorted(counts.items()):
        text += (f'{row:28}{its["killed"]:8}{its["survived"]:10}{its["not run"]:9}'
                 f'{its["killed"] / its.total():7.2f}\n')
    return text + '\nno test noticed (tests that run the line):\n' + ''.join(
        f'{mutant.file}:{mutant.lines[0]}: {mutant.what} ({tests}): {planted(mutant[:2])[1]}\n'
        for mutant, tests, killer in sorted(outcomes, key=lambda outcome: outcome[0][:2])
        if not killer)


def run(arguments: argparse.Namespace) -> None:
    """Plant faults, and print the table."""
    mutants = [one for one in draw(arguments.folders, arguments.count, arguments.seed)
               if arguments.only in f'{one.file}:{one.lines[0]}']
    start, tests = time.monotonic(), {kernels: Tests(kernels) for kernels in ('compiled', 'plain')}
    with ThreadPoolExecutor(arguments.workers) as pool:
        text = report(list(pool.map(lambda one: tests[one.kernels].outcome(one), mutants)))
    text += f'\n{len(mutants)} faults in {time.monotonic() - start:.0f} s'
    (RECORDS / 'report.txt').write_text(text)
    print(text)


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
    return run_command(lambda: arguments.run(arguments) or 0)


if __name__ == '__main__':
    sys.exit(main())
