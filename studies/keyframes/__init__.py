# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find cases where objects and keyframes together are wrong: ``python -m studies.keyframes``."""
