# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether to accept a pose: what speaks for it, how likely it is, and the decision.

comparison
    The best poses of a search: which is the likeliest, and the evidence for it.
support, attitude
    What speaks for a pose, and what its tilt says against it.
agreement
    Which poses are the same answer.
confidence
    How likely each pose is, given its support and its rivals.
look_alikes, spread
    Places that look like its own, and hypotheses near it.
recognition
    How likely a pose from keyframes is, and why it is refused.
looks
    What earlier frames say of it.
verdict
    Accept or refuse, with the reason.
"""
