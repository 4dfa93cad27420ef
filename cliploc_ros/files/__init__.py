# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fault-tolerant files and parallel tasks.

arrays
    Schema of npz files: names, types, shapes, checks.
log
    An append-only file for the results of a run, which survives a kill.
storage
    Atomic replacement of files, and the cache folder.
parallel
    Tasks on processes or on a cluster, whose workers may die.
"""
