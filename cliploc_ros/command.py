# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shared by the executables: one-line error messages, clean exit on Ctrl-C and SIGTERM."""

import argparse
import math
import os
import re
import select
import signal
import sys
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from cliploc_ros.errors import CliplocError, MapError, OptionsError

#: The shell's exit code of a command that Ctrl-C ended.
EXIT_INTERRUPTED = 130
# poll() counts milliseconds in 32 bits.
_LONGEST_WAIT_S = 2e6
# Options of the commands that have another name than the parameters of the nodes.
_OPTIONS = {'clip_checkpoint_path': 'clip_pretrained', 'matching: class': 'no_clip'}


def run_main(parser: argparse.ArgumentParser, command: Callable[[argparse.Namespace], int],
             args: Sequence[str] | None) -> int:
    """Run an executable and return its exit code. SIGTERM interrupts it as Ctrl-C does.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Parser of the program's own arguments. Arguments for ROS are stored in the options as
        ``ros_args``.
    command : callable
        Takes the options and returns the exit code, see run_command.
    args : sequence of str, optional
        The command line without the program's name. Default: the command line of this process.
    """
    plain_args, ros_args = split_ros_args(sys.argv[1:] if args is None else args)
    options = parser.parse_args(plain_args, argparse.Namespace(ros_args=ros_args))
    interrupt_on_sigterm()
    return run_command(lambda: command(options))


def run_command(command: Callable[[], int], failure: int = 1) -> int:
    """Run the body of an executable.

    Parameters
    ----------
    command : callable
        Returns the exit code.
    failure : int
        The exit code after a CliplocError.

    Returns
    -------
    int
        The exit code: `failure` after a CliplocError or a missing library, 130 when interrupted,
        141 when the reader of its output ended.
        The error is printed in one line on stderr. Other exceptions keep their traceback.
    """
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of the output ended, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # as a shell says of a program that SIGPIPE ended
    except CliplocError as error:
        # messages name `parameters` of the library; show the option of the command instead
        text = re.sub('`([a-z_: ]+)`', lambda name: '--' + _OPTIONS.get(name[1], name[1]).replace(
            '_', '-'), str(error))
        print('error:', ' '.join(text.split()), file=sys.stderr)
        return failure
    except ModuleNotFoundError as error:
        if not error.name or error.name.startswith('cliploc_ros'):
            raise
        package = error.name.partition('.')[0]
        print(f'error: {package} is not installed; pip install {_extra_with(package)}',
              file=sys.stderr)
        return failure
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return EXIT_INTERRUPTED


def _extra_with(package: str) -> str:
    """Return the extra that installs a package, as written after pip install."""
    try:
        requirements = metadata.requires('cliploc_ros') or []
    except metadata.PackageNotFoundError:  # cliploc_ros runs from its source tree
        requirements = []
    extras = re.findall(rf"^{re.escape(package)}\b.*extra == ['\"](\w+)",
                        '\n'.join(requirements), re.MULTILINE)
    return f"'cliploc_ros[{extras[0]}]'" if extras else 'the extra with it, see doc/install.md'


def printable(text: str) -> str:
    """Return text that is safe to print: ids in a map may contain control characters."""
    return ''.join(char if char.isprintable() else ' ' for char in text)


def number[Number: (int, float)](kind: type[Number], allows: Callable[[Number], bool], what: str
                                 ) -> Callable[[str], Number]:
    """Return an argparse type that accepts the numbers for which `allows` holds.

    `what` describes them in the error message, as in "2 is not within 3 and 4".
    """
    def parse(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not allows(value):
            raise argparse.ArgumentTypeError(f'{text} is not {what}')
        return value
    return parse


#: Types for argparse
positive_int = number(int, lambda value: value >= 1, '1 or more')
# beyond these limits, a time in ns or its inverse is no number any more
positive = number(float, lambda value: 1e-9 <= value <= 1e9, 'a number from 1e-9 to 1e9')
not_negative = number(float, lambda value: 0.0 <= value <= 1e9, 'a number from 0 to 1e9')
finite = number(float, lambda value: abs(value) <= 1e9, 'a number from -1e9 to 1e9')
limit = number(float, lambda value: not math.isnan(value), 'a number')  # may be infinite
#: Least and greatest seed that NumPy accepts
SEEDS = 0, 2**63 - 1


def within[Number: (int, float)](low: Number, high: Number) -> Callable[[str], Number]:
    """Return an argparse type that accepts numbers from low to high, of the type of the limits."""
    return number(type(low), lambda value: low <= value <= high, f'within {low:g} and {high:g}')


# Placeholders of paths in the help.
_PATHS = ('DIR', 'NPZ', 'YAML', 'FILE', 'JSON', 'MAP', 'BAG|DIR', 'IN')


class _Once(argparse.Action):
    """Refuses an option that is given twice; the last one would silently win."""

    given_in: argparse.Namespace | None = None  # the values do not tell: they begin with a default

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        """Take the values of the option, or raise ArgumentError."""
        if self.given_in is namespace:
            raise argparse.ArgumentError(self, 'given twice: give it once, with all its values')
        self.given_in = namespace
        super().__call__(parser, namespace, values, option_string)


def program(name: str, epilog: str, description: str, usage: str | None = None
            ) -> argparse.ArgumentParser:
    """Return the parser of a program, whose help ends with the epilog as it is written."""
    return argparse.ArgumentParser(name, usage, description, epilog,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)


def option(group: Any, shown: str, text: str | None = None,
           kind: Callable[[str], Any] | None = None, default: Any = None, **more: Any) -> None:
    """Add an option or argument to a parser, or to an argument group.

    An option is given once, unless its action is 'append' or 'extend'.

    Parameters
    ----------
    shown : str
        The names and values as the help shows them: '-r --rate X'. An option without a value, a
        kind, a default and choices is a switch.
    text : str, optional
        The help.
    kind : callable, optional
        The type for argparse. Default: Path if the value is DIR, FILE and so on.
    more
        Further arguments of add_argument.
    """
    first, *words = shown.split()
    names = [first, *(word for word in words if word.startswith('-'))]
    values = [word for word in words if not word.startswith('-')]
    if len(values) == 1:
        more['metavar'] = values[0]
        kind = kind or (Path if values[0] in _PATHS else None)
    elif values:
        more |= {'metavar': tuple(values), 'nargs': len(values)}
    if not values and kind is None and default is None and 'choices' not in more:
        more.setdefault('action', 'store_true')
    if default is not None:
        more['default'] = default
    if kind is not None:
        more['type'] = kind
    added = group.add_argument(*names, help=text, **more)
    if added.option_strings and more.get('action') not in ('append', 'extend'):
        added.__class__ = type('Once', (_Once, type(added)), {})


def check_output(path: Path) -> None:
    """Check that an output file can be written, before the work is done; else raise MapError."""
    if not path.parent.is_dir():
        raise MapError(f'{path}: there is no folder {path.parent}; create it')
    if not os.access(folder := Path(os.path.realpath(path)).parent, os.W_OK):
        raise MapError(f'{path}: {folder} cannot be written to; choose another folder')
    if path.is_dir():
        raise MapError(f'{path} is a folder; name the file to write')


@contextmanager
def needs_ros(program: str) -> Iterator[None]:
    """Convert an ImportError of ROS to an OptionsError that says how to install ROS."""
    try:
        yield
    except ImportError as error:
        raise OptionsError(
            f'{program} needs ROS 2 ({error}): source it, or run script/setup') from error


@contextmanager
def running_ros(args: Sequence[str]) -> Iterator[None]:
    """Run rclpy without its signal handlers.

    OptionsError: rclpy does not start with these arguments, or cannot write its log.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    try:
        rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl raises different types for arguments and for folders
        raise OptionsError(f'ROS 2 does not start: {error}; correct the arguments after '
                           '--ros-args, or set ROS_LOG_DIR to a writable folder') from error
    try:
        yield
    finally:
        rclpy.try_shutdown()


def split_ros_args(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split off the ROS arguments: from each ``--ros-args`` to the next ``--``.

    Launch files append them. rclpy's own function also removes every OLD:=NEW, an early notation
    of ROS 2.

    Parameters
    ----------
    args : sequence of str
        The command line without the program's name.

    Returns
    -------
    plain_args : list of str
        For the program.
    ros_args : list of str
        For ``rclpy.init``.
    """
    plain_args: list[str] = []
    ros_args: list[str] = []
    target = plain_args
    for arg in args:
        if arg == '--ros-args':
            target = ros_args
        target.append(arg)
        if arg == '--' and target is ros_args:
            target = plain_args
    return plain_args, ros_args


class StageBar:
    """A progress bar that names the stage. Without a terminal, each stage is a line."""

    def __enter__(self) -> Self:
        """Show the bar."""
        from tqdm import tqdm  # late, so that --help is fast

        self._bar = tqdm(total=100, disable=None, bar_format='{desc}: {percentage:3.0f} % |{bar}|')
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bar."""
        self._bar.close()

    def show(self, stage: str, share: float) -> None:
        """Show a stage and how much of it is done, 0 to 1."""
        if self._bar.disable and stage != getattr(self._bar, 'desc', ''):
            print(f'{stage} ...', file=sys.stderr, flush=True)
        self._bar.set_description_str(stage, refresh=False)
        self._bar.n = round(100 * share)
        self._bar.refresh()


class Interruption:
    """A flag that signal handlers set and that ends a wait.

    A threading.Event could deadlock: if a signal arrives while its thread holds the lock of the
    event, in a wait or in the handler of another signal, the handler waits for that lock for ever.
    An object that catches signals is kept until the process ends.
    """

    def __init__(self) -> None:
        self._happened = False
        self._descriptor = os.eventfd(0, os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self._descriptor)

    def catch(self, *numbers: signal.Signals) -> None:
        """Set the flag on these signals from now on."""
        for number in numbers:
            signal.signal(number, lambda *_: self.set())

    def set(self) -> None:
        """Set the flag, and end all waits."""
        self._happened = True
        os.eventfd_write(self._descriptor, 1)

    def is_set(self) -> bool:
        """Return whether the flag is set."""
        return self._happened

    def wait(self, timeout_s: float) -> bool:
        """Wait until the flag is set or the time is up; return whether it is set."""
        poll = select.poll()  # select() is limited to descriptors up to 1023
        poll.register(self._descriptor, select.POLLIN)
        poll.poll(1e3 * min(max(0.0, timeout_s), _LONGEST_WAIT_S))
        return self._happened


def interrupt_on_sigterm() -> None:
    """Make SIGTERM raise KeyboardInterrupt as Ctrl-C does, so that partial output is removed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
