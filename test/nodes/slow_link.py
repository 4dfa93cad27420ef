# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
r"""Two network namespaces joined by a slow, lossy link, for kernels without netem.

Each namespace has a tap device. This process transfers the Ethernet frames between them with a
delay of 50 ms, at 10 Mbit/s, and drops 5 % of them. Needs root.

    python test/nodes/slow_link.py python camera.py -- python -m cliploc_ros.nodes.relocalizer ...

It exits with the exit code of the left command, before the ``--``.
"""

import array
import fcntl
import heapq
import os
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import time

_DELAY_S, _LOSS, _BYTES_PER_S = 0.05, 0.05, 10e6 / 8
# The queue of the link is bounded as in a router: a fifth of a second at the rate.
_QUEUE_S = 0.2
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000


class Direction:
    """Frames in transit from one tap to the other."""

    def __init__(self, sink, seed):
        self._sink, self._random = sink, random.Random(seed)
        self._free_at, self.waiting, self._count, self.lost = 0.0, [], 0, 0

    def take(self, frame, now):
        if self._random.random() < _LOSS:
            self.lost += 1
            return
        sent_at = max(now, self._free_at) + len(frame) / _BYTES_PER_S
        if sent_at - now <= _QUEUE_S:
            self._free_at = sent_at
            self._count += 1  # frames of the same time keep their order
            heapq.heappush(self.waiting, (sent_at + _DELAY_S, self._count, frame))

    def deliver(self, now):
        while self.waiting and self.waiting[0][0] <= now:
            os.write(self._sink, heapq.heappop(self.waiting)[2])


def start(command, address):
    """Start a command in separate namespaces; return its process id and the end of its tap."""
    here, there = socket.socketpair()
    pid = os.fork()
    if pid:
        there.close()
        message = here.recvmsg(1, socket.CMSG_LEN(4))[1]
        descriptors = array.array('i')
        descriptors.frombytes(message[0][2])
        return pid, descriptors[0]
    # separate shared memory, or DDS would bypass the link
    os.unshare(os.CLONE_NEWNET | os.CLONE_NEWNS)
    tap = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, _TUNSETIFF, struct.pack('16sH', b'slow0', _IFF_TAP | _IFF_NO_PI))
    for line in ('mount --make-rprivate /', 'mount -t tmpfs tmpfs /dev/shm', 'ip link set lo up',
                 f'ip addr add {address}/24 dev slow0', 'ip link set slow0 up',
                 'ip route add 224.0.0.0/4 dev slow0'):
        subprocess.run(line.split(), check=True)
    there.sendmsg([b'.'], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array('i', [tap]))])
    os.close(tap)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SUBNET'
    os.execvp(command[0], command)


def main():
    middle = sys.argv.index('--')
    right_pid, right = start(sys.argv[middle + 1:], '10.77.0.2')
    left_pid, left = start(sys.argv[1:middle], '10.77.0.1')
    ways = {left: Direction(right, 1), right: Direction(left, 2)}
    try:
        while not (ended := os.waitpid(left_pid, os.WNOHANG))[0]:
            wait_s = min([0.05, *(way.waiting[0][0] - time.monotonic()
                                  for way in ways.values() if way.waiting)])
            for descriptor in select.select([left, right], [], [], max(0.0, wait_s))[0]:
                try:
                    for _ in range(64):
                        ways[descriptor].take(os.read(descriptor, 2048), time.monotonic())
                except BlockingIOError:
                    pass
            for way in ways.values():
                way.deliver(time.monotonic())
    finally:
        os.kill(right_pid, signal.SIGTERM)
        os.waitpid(right_pid, 0)
    print(f'{ways[left].lost} packets of the camera lost', flush=True)
    return os.waitstatus_to_exitcode(ended[1])


if __name__ == '__main__':
    sys.exit(main())
