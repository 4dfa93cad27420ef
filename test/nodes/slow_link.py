# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
r"""Two network namespaces joined by a slow, lossy link, for kernels without netem.

Each namespace has a tap device. This process transfers the Ethernet frames between them with a
delay, at a limited rate, and drops some. Needs root.

    python test/nodes/slow_link.py --delay-ms 50 --loss 0.05 --rate-mbit 10 \
        --left python camera.py ... --right python -m cliploc_ros.nodes.relocalizer ...

It exits with the left command and its exit code.
"""

import argparse
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

_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
# The queue of the link is bounded as in a router: a fifth of a second at the rate.
_QUEUE_S = 0.2


class Direction:
    """Frames in transit from one tap to the other."""

    def __init__(self, sink, options, seed):
        self._sink, self._options, self._random = sink, options, random.Random(seed)
        self._free_at, self._waiting, self._count = 0.0, [], 0
        self.carried = self.lost = self.overflown = self.bytes = 0

    def take(self, frame, now):
        if self._random.random() < self._options.loss:
            self.lost += 1
            return
        sent_at = max(now, self._free_at) + 8e-6 * len(frame) / self._options.rate_mbit
        if sent_at - now > _QUEUE_S:
            self.overflown += 1
            return
        self._free_at = sent_at
        self._count += 1  # frames of the same time keep their order
        heapq.heappush(self._waiting, (sent_at + self._options.delay_ms / 1e3, self._count, frame))

    def deliver(self, now):
        while self._waiting and self._waiting[0][0] <= now:
            frame = heapq.heappop(self._waiting)[2]
            os.write(self._sink, frame)
            self.carried, self.bytes = self.carried + 1, self.bytes + len(frame)

    @property
    def next_at(self):
        return self._waiting[0][0] if self._waiting else float('inf')

    def __str__(self):
        return (f'{self.carried} frames, {self.bytes / 1e6:.2f} MB; {self.lost} lost, '
                f'{self.overflown} did not fit')


def tap():
    """Create the tap device of this namespace; return its file descriptor."""
    descriptor = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack('16sH', b'slow0', _IFF_TAP | _IFF_NO_PI))
    return descriptor


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
    descriptor = tap()
    for line in ('mount --make-rprivate /', 'mount -t tmpfs tmpfs /dev/shm', 'ip link set lo up',
                 f'ip addr add {address}/24 dev slow0', 'ip link set slow0 up',
                 'ip route add 224.0.0.0/4 dev slow0'):
        subprocess.run(line.split(), check=True)
    there.sendmsg([b'.'], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array('i', [descriptor]))])
    os.close(descriptor)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SUBNET'
    os.execvp(command[0], command)


def carry(left, right, options, is_over):
    """Transfer frames between two taps until the end; return both directions."""
    ways = {left: Direction(right, options, 1), right: Direction(left, options, 2)}
    while not is_over():
        wait_s = min(way.next_at for way in ways.values()) - time.monotonic()
        ready = select.select([left, right], [], [], max(0.0, min(0.05, wait_s)))[0]
        for descriptor in ready:
            try:
                for _ in range(64):
                    ways[descriptor].take(os.read(descriptor, 2048), time.monotonic())
            except BlockingIOError:
                pass
        for way in ways.values():
            way.deliver(time.monotonic())
    return ways[left], ways[right]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--delay-ms', type=float, default=50.0)
    parser.add_argument('--loss', type=float, default=0.05)
    parser.add_argument('--rate-mbit', type=float, default=10.0)
    arguments = sys.argv[1:]
    first, second = arguments.index('--left'), arguments.index('--right')
    options = parser.parse_args(arguments[:first])
    code = []

    def is_over():
        ended, status = os.waitpid(left_pid, os.WNOHANG)
        if ended:
            code.append(os.waitstatus_to_exitcode(status))
        return bool(ended)
    right_pid, right = start(arguments[second + 1:], '10.77.0.2')
    left_pid, left = start(arguments[first + 1:second], '10.77.0.1')
    try:
        there, back = carry(left, right, options, is_over)
        print(f'left to right: {there}\nright to left: {back}', flush=True)
    finally:
        os.kill(right_pid, signal.SIGTERM)
        os.waitpid(right_pid, 0)
    return code[0]


if __name__ == '__main__':
    sys.exit(main())
