# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure the tables of the pages: ``python -m studies.results NAME... --data FOLDER``.

The program runs the command of each NAME in results.yaml and writes its output to results/NAME.md,
with the command, the revision and the time. script/document then copies sections of it into the
pages. A digest at the end of the file reveals edits by hand.
"""

import argparse
import hashlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import yaml

from cliploc_ros.command import run_command
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import make_folder, write_text

FOLDER = Path(__file__).parent / 'results'
COMMANDS = Path(__file__).with_suffix('.yaml')
_HEAD = """\
# {name}

Written by `python -m studies.results {name}`. Do not edit.

| | |
| --- | --- |
| command | `python -m {command}` |
| revision | {revision} |
| measured | {day}, in {minutes:.0f} min on {cores} cores |

"""
_TAIL = re.compile(r'<!-- sha256 of the lines above: ([0-9a-f]{64}) -->\n\Z')


def section(name: str, heading: str) -> str:
    """Return a section of a result, without its heading.

    ValueError: the file is missing or was edited by hand, or has no such section.
    """
    path = FOLDER / f'{name}.md'
    text = path.read_text() if path.exists() else ''
    found = _TAIL.search(text)
    body = text[:found.start()] if found else text
    if found is None or _digest(body) != found[1]:
        raise ValueError(f'results/{name}.md is missing or was edited: run '
                         f'python -m studies.results {name}')
    sections = dict(re.findall(r'^## (.+)\n\n((?:(?!## ).*\n)*)', body, re.MULTILINE))
    if heading not in sections:
        raise ValueError(f'results/{name}.md has no section {heading}, but {", ".join(sections)}')
    return sections[heading].strip()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def measure(name: str, command: str, data: Path) -> None:
    """Run a command, and write its output to results/NAME.md."""
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_results_') as out:
        words = [file for word in shlex.split(command)
                 for file in _files(word.replace('DATA', str(data)).replace('OUT', out))]
        began = time.monotonic()
        done = subprocess.run([sys.executable, '-m', *words], stdout=subprocess.PIPE, text=True,
                              check=False)
    if done.returncode:
        raise OptionsError(f'{name}: the command ended with {done.returncode}: {command}')
    body = _HEAD.format(
        name=name, command=command.strip(), revision=_revision(), day=datetime.now(UTC).date(),
        minutes=(time.monotonic() - began) / 60.0, cores=os.cpu_count()) + done.stdout
    make_folder(FOLDER)
    write_text(FOLDER / f'{name}.md',
               f'{body}<!-- sha256 of the lines above: {_digest(body)} -->\n')


def _files(word: str) -> list[str]:
    path = Path(word)
    return sorted(map(str, path.parent.glob(path.name))) if '*' in word else [word]


def _revision() -> str:
    return subprocess.run(['git', 'describe', '--always', '--dirty'], cwd=COMMANDS.parent,
                          stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def run() -> int:
    """Measure the results named on the command line."""
    commands = yaml.safe_load(COMMANDS.read_text())
    parser = argparse.ArgumentParser(prog='python -m studies.results', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='+', choices=commands, metavar='NAME',
                        help=', '.join(commands))
    parser.add_argument('--data', type=Path, default=Path('data'),
                        help='folder DATA of results.yaml (%(default)s)')
    options = parser.parse_args()
    for name in options.names:
        if 'DATA' in commands[name] and not options.data.is_dir():
            raise OptionsError(f'--data {options.data}: no such folder; for its content see '
                               'studies/README.md, "Results"')
        measure(name, commands[name], options.data.resolve())
    return 0


if __name__ == '__main__':
    sys.exit(run_command(run))
