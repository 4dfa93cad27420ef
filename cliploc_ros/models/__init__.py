# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Neural networks behind two small protocols: an object detector, an image-text encoder.

Importing this package imports neither torch nor open_clip nor ultralytics; making an encoder or a
detector does.
"""
