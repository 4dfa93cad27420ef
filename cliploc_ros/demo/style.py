# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the demo's pictures and its page share: colours and words."""

from cliploc_ros.demo.review import Judged

#: Blue and vermilion of Okabe and Ito, which the colour-blind can tell apart.
ACCEPTED, REFUSED = '#0072B2', '#D55E00'


def verdict(judged: Judged) -> str:
    """Return in words what became of a wake-up."""
    if not judged.wake_up.accepted:
        return 'refused' if judged.error is None else (
            f'refused, the best hypothesis is {judged.error[0]:.2f} m off')
    if judged.error is None:
        return 'accepted'
    return f'accepted, {judged.error[0]:.2f} m and {judged.error[1]:.1f}° from the truth'
