# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure the start of the relocalizer with the demo's map: the first ones, and a warm one.

    python -m studies.speed node_start [--package FOLDER]

Each start is a process of its own, from its command line to its log line that it is ready.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from demo import ASSETS

_PROJECT = Path(__file__).resolve().parents[2]
_READY = 'landmarks in frame'
# 'colcon build' finds no kernels, 'script/setup' finds kernels and no labels of the map.
STARTS = ('colcon build', 'script/setup', 'warm')
MATCHINGS = ('class', 'hybrid')


@dataclass(frozen=True)
class NodeStart:
    """Time of one start, from the command line until the node is ready."""

    #: One of MATCHINGS, one of STARTS
    matching: str
    kind: str
    #: Elapsed time, and user and system time of the process [s]
    wall_s: float
    processor_s: float


def measure_starts(package: Path, matching: str) -> list[NodeStart]:
    """Start the relocalizer of a package once in each way."""
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_start_') as name:
        folder = Path(name)
        found = [_start(package, matching, STARTS[0], folder / 'kernels', folder / 'cache')]
        found.append(_start(package, matching, STARTS[1], folder / 'kernels', folder / 'second'))
        found.append(_start(package, matching, STARTS[2], folder / 'kernels', folder / 'second'))
        return found


def _start(package: Path, matching: str, kind: str, kernels: Path, cache: Path) -> NodeStart:
    """Start the relocalizer with kernels of one folder and label embeddings of another."""
    parameters = {'map_file': ASSETS / 'map.yaml', 'matching': matching, 'device': 'cpu',
                  'clip_model': ASSETS / 'clip.json', 'cache_dir': cache,
                  'clip_pretrained': ASSETS / 'clip.safetensors'}
    command = [sys.executable, '-m', 'cliploc_ros.nodes.relocalizer', '--ros-args']
    for name, value in parameters.items():
        command += ['-p', f'{name}:={value}']
    environment = {'NUMBA_CACHE_DIR': str(kernels), 'PYTHONPATH': str(package),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    begin = time.monotonic()
    with subprocess.Popen(command, cwd=package, env=os.environ | environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if _READY in line:
                break
        else:
            raise SystemExit(f'the relocalizer does not start:\n{"".join(lines)}')
        wall_s, processor_s = time.monotonic() - begin, _processor_s(process.pid)
        process.terminate()
    return NodeStart(matching, kind, wall_s, processor_s)


def _processor_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def format_starts(starts: list[NodeStart]) -> str:
    """Return a table, with the time above that of a warm start."""
    warm = {each.matching: each for each in starts if each.kind == STARTS[-1]}
    lines = [f'{"matching":<9} {"first start after":<18} {"processor s":>12} {"above warm":>11} '
             f'{"wall s":>7}']
    lines += [f'{each.matching:<9} {each.kind:<18} {each.processor_s:12.1f} '
              f'{each.processor_s - warm[each.matching].processor_s:11.1f} {each.wall_s:7.1f}'
              for each in starts]
    return '\n'.join(lines)


def run(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--package', type=Path, default=_PROJECT, metavar='FOLDER',
                        help='folder with the package to measure (default: this one)')
    package = parser.parse_args(arguments).package.resolve()
    print(format_starts([start for matching in MATCHINGS
                         for start in measure_starts(package, matching)]))
    return 0
