# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Print phrases: ``python -m cliploc_ros.vocabulary.print_phrases cup --vocabulary my.yaml``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.command import run_command
from cliploc_ros.vocabulary.vocabulary import load_vocabulary, shipped_classes


def main(args: Sequence[str] | None = None) -> int:
    """Print phrases; return the exit code."""
    parser = argparse.ArgumentParser(prog='print_phrases',
                                     description='Print the phrases of classes.')
    parser.add_argument('classes', nargs='*', metavar='CLASS',
                        help='print its phrases; none: the number of phrases of each class')
    parser.add_argument('--vocabulary', type=Path, metavar='FILE', help="with the user's phrases")
    options = parser.parse_args(args)
    return run_command(lambda: _print(options))


def _print(options: argparse.Namespace) -> int:
    vocabulary = load_vocabulary(options.vocabulary)
    for name in options.classes:
        print('\n'.join(vocabulary.phrases(name)))
    if not options.classes:
        for name in dict.fromkeys([*vocabulary.added, *shipped_classes()]):
            print(f'{len(vocabulary.phrases(name)):5} {name}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
