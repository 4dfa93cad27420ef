# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands in the documents, as a shell would split them."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
PAGES = [PROJECT / 'README.md', PROJECT / 'CONTRIBUTING.md', PROJECT / 'SECURITY.md',
         PROJECT / 'studies/README.md', *sorted((PROJECT / 'doc').glob('*.md'))]
# Programs of other packages, and keywords of the shell. An unlisted program fails the test.
FOREIGN = {'bloom-release', 'cd', 'cp', 'dask', 'docker', 'done', 'export', 'git', 'grep', 'pip',
           'rosdep', 'rosdoc2', 'rsync', 'rviz2', 'sleep', 'source', 'sudo', 'touch'}
_BEGINS_SHELL = re.compile(r'(ros2|script/|python3? -|install/lib/cliploc_ros/|cliploc_\w+ |'
                           r'source |pip |sudo |\w+=\$|until |rviz2 |(evaluate|build_map) -)')
_FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
# A block is indented by four spaces, or by eight in a list; text of a list item is not a block.
_INDENTED = re.compile(r'(?<=\n\n)(?: {4,}\S.*\n(?:\n(?= {4}))?)+')
_OPERATORS = {'|', ';', '&&', '&', '||'}
_WORDS = {'until', 'do', 'then', 'while', 'if'}


@dataclass(frozen=True)
class Command:
    """A program with its arguments, and the page that contains it."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        """Return the command as a line, for the name of a test."""
        return f'{self.page}: {shlex.join(self.words)}'


def commands() -> list[Command]:
    """Return every command of every page, without duplicates."""
    return list(dict.fromkeys(command for page in PAGES for command in commands_of(page)))


def commands_of(page: Path) -> list[Command]:
    """Return the commands of the shell blocks of a page, in their order."""
    return [Command(page.name, words) for block in shell_blocks(page.read_text())
            for line in block.replace('\\\n', ' ').splitlines() for words in split(line)]


def shell_blocks(text: str) -> list[str]:
    """Return the fenced blocks marked sh, and the indented blocks that begin with a command."""
    fenced = [body for language, body in _FENCE.findall(text) if language == 'sh']
    indented = [match.group() for match in _INDENTED.finditer(_FENCE.sub('', text))]
    return fenced + [block for block in indented if _BEGINS_SHELL.match(block.lstrip())]


def split(line: str) -> Iterator[tuple[str, ...]]:
    """Split a line into its commands; the content of $( ) is a separate command."""
    line = re.sub(r'(?<=\s)\[|\](?=\s|$)', '', line)  # [--option] may be left out
    for inner in re.findall(r'\$\(([^)]*)\)', line):
        yield from split(inner)
    lexer = shlex.shlex(re.sub(r'\$\([^)]*\)', 'SUBSTITUTED', line), posix=True,
                        punctuation_chars=';&|')
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ';']:
        if word not in _OPERATORS:
            words.append(word)
            continue
        while words and (words[0] in _WORDS or re.match(r'\w+=', words[0])):
            del words[0]
        if words:
            yield tuple(words)
        words = []


def inline_commands() -> list[Command]:
    """Return the commands within sentences that have at least one option."""
    found = []
    for page in PAGES:
        text = _INDENTED.sub('', _FENCE.sub('', page.read_text()))
        for code in re.findall(r'`([^`]+)`', text):
            words = code.replace('\n', ' ').split()
            if len(words) > 1 and any(word.startswith('--') for word in words[1:]):
                found.append(Command(page.name, tuple(words)))
    return list(dict.fromkeys(found))
