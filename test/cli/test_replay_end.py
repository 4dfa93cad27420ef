# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable replay ends when its subscribers have all messages, or says which lack some."""

import signal
import subprocess
import sys

import pytest
from executables import TIMEOUT_S, write_poses

# Prints 'received' at the third message.
SUBSCRIBER = """
import rclpy
from geometry_msgs.msg import PoseStamped
rclpy.init()
node = rclpy.create_node('subscriber')
received = []
node.create_subscription(PoseStamped, '/pose', received.append, 10)
print('ready', flush=True)
while len(received) < 3:
    rclpy.spin_once(node, timeout_sec=0.1)
print('received', flush=True)
"""


@pytest.fixture
def subscriber():
    """Start a reliable subscriber of /pose in a process of its own."""
    process = subprocess.Popen([sys.executable, '-c', SUBSCRIBER], stdout=subprocess.PIPE,
                               text=True)
    assert process.stdout.readline() == 'ready\n'
    yield process
    process.kill()
    process.communicate()


def play_to_a_stopped(subscriber, start, tmp_path, *args):
    """Publish three messages, the last two while the subscriber's process is stopped."""
    bag = write_poses(tmp_path / 'bag', [0, 1000, 1050])
    replay = start('replay', bag, '--wait-for-subscribers', *args)
    assert 'replaying' in replay.stdout.readline()
    subscriber.send_signal(signal.SIGSTOP)
    assert 'published 3 ' in replay.stdout.readline()
    return replay


def test_replay_waits_until_its_messages_have_arrived(subscriber, start, tmp_path):
    replay = play_to_a_stopped(subscriber, start, tmp_path)
    with pytest.raises(subprocess.TimeoutExpired):
        replay.wait(2.0)
    subscriber.send_signal(signal.SIGCONT)
    assert subscriber.stdout.readline() == 'received\n'
    _, errors = replay.communicate(timeout=TIMEOUT_S)
    assert (replay.returncode, errors) == (0, '')


def test_replay_names_topics_without_acknowledgement(subscriber, start, tmp_path):
    replay = play_to_a_stopped(subscriber, start, tmp_path, '--wait-for-all-acked', 0.5)
    _, errors = replay.communicate(timeout=TIMEOUT_S)
    assert replay.returncode == 0
    assert errors.startswith('warning: ') and '/pose' in errors and '0.5 s' in errors
