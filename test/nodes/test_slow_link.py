# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera and relocalizer on two machines with a simulated slow link that loses packets."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from processes import PROJECT

pytestmark = pytest.mark.full

REQUESTS = 4
POSSIBLE = os.geteuid() == 0 and os.access('/dev/net/tun', os.W_OK)


@pytest.mark.needs('ip')
@pytest.mark.skipif(not POSSIBLE, reason='network namespaces with taps need root and /dev/net/tun')
def test_every_request_over_a_slow_link_is_answered_once(room_map):
    here = PROJECT / 'test/nodes'
    parameters = [argument for name, value in (
        ('map_file', room_map), ('matching', 'class'), ('algorithm', 'bf'), ('timeout_s', 20.0),
        ('image_transport', 'compressed')) for argument in ('-p', f'{name}:={value}')]
    done = subprocess.run(
        [sys.executable, here / 'slow_link.py', sys.executable, here / 'remote_camera.py',
         str(REQUESTS), '--', sys.executable, '-m', 'cliploc_ros.nodes.relocalizer', '--ros-args',
         *parameters],
        capture_output=True, text=True, timeout=150, cwd=PROJECT, env=os.environ | {
            'PYTHONPATH': os.pathsep.join([str(PROJECT), str(here.parent), str(here),
                                           os.environ.get('PYTHONPATH', '')]),
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROJECT / 'config/fastdds_slow_network.xml'),
            'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'})
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line.removeprefix('ANSWER ')) for line in done.stdout.splitlines()
               if line.startswith('ANSWER ')]
    lost = int(re.search(r'(\d+) packets of the camera lost', done.stdout)[1])
    print(f'\n50 ms, 5 % loss, 10 Mbit/s: answers after '
          f'{[answer["seconds"] for answer in answers]} s; {lost} packets lost')
    assert lost > 0
    assert len(answers) == REQUESTS
    for answer, x in zip(answers, 0.3 + 0.05 * np.arange(REQUESTS), strict=True):
        # a request without an image fails; no answer has a wrong pose
        assert answer['message'].startswith((f'accepted: x {x:.2f} y -0.20 z -0.50 m in map, ',
                                             'no new frame'))
        assert answer['seconds'] < 21.0
    assert sum(answer['success'] for answer in answers) >= REQUESTS - 1
