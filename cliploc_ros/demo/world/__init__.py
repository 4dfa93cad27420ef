# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic world: objects told apart by their labels, a room, cameras and their images."""
