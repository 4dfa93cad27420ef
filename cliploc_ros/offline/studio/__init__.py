# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map studio: the edited map, the actions on it, and the page in the browser."""
