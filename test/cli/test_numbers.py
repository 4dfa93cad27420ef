# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""No executable accepts text that is not a number as a number, or an option twice."""

import argparse
import contextlib
import os
import subprocess
import sys
from importlib import import_module

import pytest

PROGRAMS = ('build_map', 'check_map', 'demo', 'doctor', 'evaluate', 'export_network',
            'import_map', 'replay', 'studio', 'tum_to_bag', 'wake_up')
#: Options without a limit may accept infinity.
MAY_BE_INFINITE = {'--height-range'}


#: Options that may be repeated
REPEATED = {'--params-file', '--poses'}
RECORDINGS = {'--bag', '--tum', '--rgbd', '--folder', '--colmap', '--nerf', '--observations'}


def parser_of(program):
    module = 'demo.__main__' if program == 'demo' else f'cliploc_ros.cli.{program}'
    return import_module(module).make_parser()


def options_of(program):
    return [action for action in parser_of(program)._actions
            if action.option_strings and action.type]


def takes(action, text):
    try:
        return isinstance(action.type(text), int | float)
    except (ValueError, argparse.ArgumentTypeError):
        return False


@pytest.mark.parametrize('program', PROGRAMS)
def test_options_that_are_numbers_refuse_nan_infinity_and_what_overflows(program):
    for action in options_of(program):
        name = action.option_strings[-1]
        assert not takes(action, 'nan'), name
        for text in ('inf', '1e300'):
            assert takes(action, text) == (name in MAY_BE_INFINITE), name


@pytest.mark.parametrize(('program', 'name'), [
    ('build_map', '--max-gap'), ('build_map', '--seed'), ('build_map', '--keyframes'),
    ('build_map', '--depth-unit'), ('build_map', '--workers'), ('check_map', '--folds'),
    ('evaluate', '--max-gap'), ('evaluate', '--seed'), ('import_map', '--scale'),
    ('tum_to_bag', '--every')])
def test_what_is_counted_or_measured_is_not_negative(program, name):
    action = next(action for action in options_of(program) if name in action.option_strings)
    assert takes(action, '2') and not takes(action, '-1')


@pytest.mark.parametrize('program', PROGRAMS)
def test_an_option_is_given_once(program, capsys):
    """Also by different names, and after an earlier command line of the same parser."""
    parser = parser_of(program)
    for action in parser._actions[1:]:  # without --help
        if not action.option_strings:
            continue
        action.type = action.choices = None
        values = ['1'] * (action.nargs if isinstance(action.nargs, int) else 1)
        once, again = ([name, *values] for name in (
            action.option_strings[0], action.option_strings[-1]))
        for words, is_refused in ((once, False), (once + once, True), (once + again, True)):
            with contextlib.suppress(SystemExit):  # required arguments are missing
                parser.parse_args(words)
            assert ('given twice' in capsys.readouterr().err) == (
                is_refused and again[0] not in REPEATED and not (
                    program == 'build_map' and again[0] in RECORDINGS)), words


def test_a_program_ends_quietly_with_the_reader_of_its_output():
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, '-c', 'import sys; from cliploc_ros.command import '
                           'run_command; sys.exit(run_command(lambda: print("x") or 0))'],
                          stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b'')
