# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A bond with the signatures of the real one, and its half of the heartbeat.

The message is a KeyValue, whose fields check their types, in place of bond/msg/Status.
"""

import threading

from diagnostic_msgs.msg import KeyValue
from rclpy.duration import Duration


class Bond:
    """Says that a node is alive until shutdown says that it is not."""

    def __init__(self, node, topic, id, on_broken=None, on_formed=None):
        self.id = id
        self._node, self._topic = node, topic
        self.pub = node.create_publisher(KeyValue, topic, 1)
        self._ended = threading.Event()

    def set_heartbeat_period(self, dur):
        self._period_s = dur

    def set_heartbeat_timeout(self, dur):
        assert dur > self._period_s

    def start(self):
        self.sub = self._node.create_subscription(KeyValue, self._topic, lambda _: None, 1)
        threading.Thread(target=self._beat, daemon=True).start()

    def _beat(self):
        self._publish('alive')
        while not self._ended.wait(self._period_s):
            self._publish('alive')

    def _publish(self, state):
        self.pub.publish(KeyValue(key=self.id, value=state))

    def shutdown(self):
        """Destroy what was created, behind the node's back like the real one."""
        self.sub.destroy()
        self._ended.set()
        self._publish('dead')
        # the real one may lose this message; its peer then misses the heartbeat instead
        self.pub.wait_for_all_acked(Duration(seconds=5))
        self.pub.destroy()
