# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Colours and words that the demo's pictures and page share."""

from cliploc_ros.demo.review import Judged

#: Okabe and Ito's blue and vermilion, which colour-blind readers can distinguish.
ACCEPTED, REFUSED = '#0072B2', '#D55E00'


def verdict(judged: Judged) -> str:
    """Return the outcome of a wake-up in words."""
    if not judged.wake_up.accepted:
        return 'refused' if judged.error is None else (
            f'refused, the best hypothesis is {judged.error[0]:.2f} m off')
    if judged.error is None:
        return 'accepted'
    return f'accepted, {judged.error[0]:.2f} m and {judged.error[1]:.1f}° from the truth'
