# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How often poses are accepted, rightly and wrongly, and the fit of the confidence."""
