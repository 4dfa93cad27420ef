# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make an observation file of a recording: run detector and CLIP once over its images."""
