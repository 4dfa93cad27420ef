# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One command for a folder of studies, each a subcommand."""

import argparse
import sys
from collections.abc import Mapping
from importlib import import_module

from cliploc_ros.command import run_command


def run_one_of(package: str, studies: Mapping[str, str]) -> int:
    """Run the study that the command line names; return the exit code.

    Parameters
    ----------
    package : str
        Has a module with a function `run(arguments) -> int` for each study.
    studies : mapping
        Names of the studies, and what each measures.
    """
    parser = argparse.ArgumentParser(
        prog=f'python -m {package}', formatter_class=argparse.RawDescriptionHelpFormatter,
        description=f'Run a study; python -m {package} STUDY --help shows its options.',
        epilog='\n'.join(f'{name:12} {summary}' for name, summary in studies.items()))
    parser.add_argument('study', choices=studies)
    study = parser.parse_args(sys.argv[1:2]).study
    sys.argv[0] = f'python -m {package} {study}'  # argparse's name of the program
    module = import_module(f'{package}.{study}')
    return run_command(lambda: module.run(sys.argv[2:]))
