# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the pictures and the page of a check share.

The colours are those of Okabe and Ito, which the colour-blind can distinguish.
"""

from cliploc_ros.mapping.checking.landmark_faults import LandmarkCheck
from cliploc_ros.mapping.checking.report import SERIOUS

ACCEPTED, REFUSED, MISLED = '#0072B2', '#E69F00', '#D55E00'
SOUND, MINOR, FAULTY = '#009E73', '#E69F00', '#D55E00'
LOOK_ALIKE, INK, FAINT = '#CC79A7', '#222222', '#999999'
VERDICT_COLORS = {'accepted': ACCEPTED, 'refused': REFUSED, 'misled': MISLED}


def grade(landmark: LandmarkCheck) -> str:
    """Return 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


GRADE_COLORS = {'faulty': FAULTY, 'minor': MINOR, 'sound': SOUND}
GRADE_NAMES = {'faulty': 'serious fault', 'minor': 'minor fault', 'sound': 'sound'}
