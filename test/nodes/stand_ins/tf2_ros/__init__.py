# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A tf2 that knows no coordinate frame, and is late to say so, as on a busy machine."""

import time

_LATE_S = 0.45


class Buffer:
    """Has no transform."""

    def lookup_transform(self, target_frame, source_frame, stamp, timeout):
        time.sleep(timeout.nanoseconds * 1e-9 + _LATE_S)
        raise LookupError(f'"{source_frame}" does not exist')

    def clear(self):
        pass


class TransformListener:
    """Hears nothing."""

    def __init__(self, buffer, node):
        pass

    def unregister(self):
        pass
