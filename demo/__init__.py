# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo runs the complete system: a robot wakes up in a synthetic room.

Run it with ``python -m demo`` from the root of the repository; it is not installed. The programs
in ``demo.world`` built the room and trained the networks in ``assets``.
"""

from pathlib import Path

#: The shipped room: sequence/ (a TUM folder), map.yaml, and the weights of YOLO and CLIP.
ASSETS = Path(__file__).parent / 'assets'
