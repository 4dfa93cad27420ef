# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A bond with bondpy's signatures and one half of the heartbeat.

The message is a KeyValue, whose fields check their types, in place of bond/msg/Status.
"""

import threading

from diagnostic_msgs.msg import KeyValue


class Bond:
    """Reports that a node is alive until the bond is broken."""

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

    def break_bond(self):
        self._ended.set()
        self._publish('dead')

    def shutdown(self):
        """Destroy all entities at once without notice to the node, like the real bond.

        Messages in transit are then lost; a peer of the real bond misses the heartbeat.
        """
        self.sub.destroy()
        if not self._ended.is_set():
            self.break_bond()
        self.pub.destroy()
