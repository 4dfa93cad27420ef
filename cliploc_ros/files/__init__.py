# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files and work that outlive trouble: npz files, logs, folders, parallel tasks.

arrays
    The one schema of npz files: names, types, shapes, checks.
log
    An append-only file with the results of a run, also of a killed one.
storage
    A file in the place of another one in one step, and the cache folder.
parallel
    Tasks on processes or on a cluster, some of whose workers die.
"""
