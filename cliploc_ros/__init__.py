# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where is the robot? Global localization in a map of labelled objects, from one image.

The subpackages, in the order in which data flows: ``datasets`` or ``ros`` (input),
``models`` (detector and encoder), ``core`` (the method), ``nodes`` and ``cli`` (entry points).
"""
