# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure times and memory: ``python -m studies.speed --help``."""

import argparse
import sys
from importlib import import_module

from cliploc_ros.command import run_command

STUDIES = {
    'search': 'the search, compared with a plain loop in the same run, and by size of the map',
    'growth': 'build, check, load and request of 300 to 20,000 keyframes',
    'frame': 'a request by stage, for two pairs of networks',
    'node_start': 'the start of the relocalizer'}

if __name__ == '__main__':
    parser = argparse.ArgumentParser(
        prog='python -m studies.speed', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Run a study; python -m studies.speed STUDY --help shows its options.',
        epilog='\n'.join(f'{name:12} {summary}' for name, summary in STUDIES.items()))
    parser.add_argument('study', choices=STUDIES)
    study = parser.parse_args(sys.argv[1:2]).study
    sys.argv[0] = f'python -m studies.speed {study}'  # argparse's name of the program
    module = import_module(f'studies.speed.{study}')
    sys.exit(run_command(lambda: module.run(sys.argv[2:])))
