# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images of several cameras at one instant, for a detector that cannot process all of them."""

import threading

import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cliploc_ros.nodes.detector import NewestInstant, TimedImage
from cliploc_ros.ros.node.threads import Worker

PATIENCE_S = 60.0


def image(stamp):
    return TimedImage(Image(header=Header(stamp=Time(sec=stamp))), float(stamp))


def shown_to_a_busy_worker(offers):
    """Return the images that a busy worker processes."""
    worker, seen = Worker(print), []
    entered, gate = threading.Event(), threading.Event()

    def work(camera, one):
        seen.append((camera, one.msg.header.stamp.sec))
        entered.set()
        gate.wait(PATIENCE_S)
    newest = NewestInstant(worker, work)
    newest.offer('first', image(0))
    assert entered.wait(PATIENCE_S)
    for camera, stamp in offers:
        newest.offer(camera, image(stamp))
    since = newest.waiting_since
    gate.set()
    for _ in range(3):
        worker.run(lambda: None)
    worker.stop()
    assert newest.waiting_since is None
    return seen[1:], newest.dropped, since


@pytest.mark.parametrize(('offers', 'expected', 'dropped'), [
    # the newest instant that both have, then the remaining images
    ([('a', 1), ('b', 1), ('a', 2)], [('a', 1), ('b', 1), ('a', 2)], 0),
    ([('a', 1), ('b', 1), ('a', 2), ('b', 2)], [('a', 2), ('b', 2)], 2),
    ([('a', 1), ('a', 2), ('a', 3), ('b', 1)], [('a', 2), ('b', 1), ('a', 3)], 1),
    # a late camera does not delay the others
    ([('a', 8), ('a', 9), ('b', 3)], [('a', 8), ('b', 3), ('a', 9)], 0),
])
def test_images_of_one_instant_come_together(offers, expected, dropped):
    seen, lost, since = shown_to_a_busy_worker(offers)
    assert (seen, lost) == (expected, dropped)
    assert since is not None
