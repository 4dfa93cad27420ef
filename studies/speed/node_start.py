# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure the start of the relocalizer with the demo's map: first starts, and a warm start.

    python -m studies.speed node_start [--package FOLDER]

Each start is a separate process; it is measured from its command line to its log line 'ready'.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from demo import ASSETS
from studies.reports import print_section, table

_PROJECT = Path(__file__).resolve().parents[2]
_READY = 'landmarks in frame'
# State before a start, and the folder of label embeddings. After 'colcon build' there are no
# compiled kernels; after 'script/setup' there are kernels, but no embeddings of the map's labels.
_STARTS = {'colcon build': 'first', 'script/setup': 'second', 'warm': 'second'}


def _start(package: Path, matching: str, kernels: Path, cache: Path) -> tuple[float, float]:
    """Return processor time and elapsed time [s] until the relocalizer of a package is ready."""
    parameters = {'map_file': ASSETS / 'map.yaml', 'matching': matching,
                  'clip_pretrained': ASSETS / 'clip', 'cache_dir': cache}
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
            raise SystemExit(f'the relocalizer did not start:\n{"".join(lines)}')
        wall_s = time.monotonic() - begin
        # user and system time, the 14th and 15th field of proc(5)
        fields = Path(f'/proc/{process.pid}/stat').read_text().rsplit(')', 1)[1].split()
        process.terminate()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK'), wall_s


def run(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--package', type=Path, default=_PROJECT, metavar='FOLDER',
                        help='folder with the package to measure (default: this one)')
    package = parser.parse_args(arguments).package.resolve()
    rows = []
    for matching in ('class', 'hybrid'):
        with tempfile.TemporaryDirectory(prefix='cliploc_ros_start_') as name:
            rows += [[matching, kind, *(f'{time_s:.1f}' for time_s in _start(
                package, matching, Path(name, 'kernels'), Path(name, cache)))]
                for kind, cache in _STARTS.items()]
    print_section('Time until ready', table(
        ['matching', 'first start after', 'processor time [s]', 'wall time [s]'], rows))
    return 0
