# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small world for evaluations."""

from recorded_room import files, recording, room

__all__ = ['files', 'recording', 'room']
