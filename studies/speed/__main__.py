# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How long things take, and what memory they need: ``python -m studies.speed --help``."""

import sys

from studies.commands import run_one_of

if __name__ == '__main__':
    sys.exit(run_one_of('studies.speed', {
        'search': 'the search, beside a plain loop in the same run, and against the map',
        'frame': 'a request by stage, for each profile, in PyTorch and OpenVINO',
        'startup': 'the start of CLIP',
        'node_start': 'the start of the relocalizer',
        'building': 'a building of many floors: verdicts and times',
        'floor': 'mapping a simulated floor of 5,000 objects in an hour',
        'pose_errors': 'maps of disturbed poses'}))
