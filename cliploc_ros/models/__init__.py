# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Neural networks: a detector and an image-text encoder behind two protocols, and XFeat.

Importing this package does not import torch, open_clip or ultralytics; constructing an encoder or
a detector does.
"""
