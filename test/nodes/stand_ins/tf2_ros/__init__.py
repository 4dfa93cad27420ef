# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A tf2 without coordinate frames that answers late, as on a busy machine."""

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
