# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of every node: lifecycle, executor, parameters, worker, diagnostics."""
