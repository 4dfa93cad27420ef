# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide whether a pose is accepted, or a running pose doubted.

They are read from calibration.yaml.
"""

from pathlib import Path
from typing import NamedTuple

import yaml

FILE = Path(__file__).with_name('calibration.yaml')


class Terms(dict[str, float]):
    """The numbers of a section by name; calibration.yaml states the meaning of each number."""

    def __getattr__(self, name: str) -> float:
        """Return the number of a name."""
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f'calibration.yaml has no {name} here') from None

    def _replace(self, **numbers: float) -> 'Terms':
        """Return the section with some numbers replaced."""
        return Terms(self | numbers)


class Calibration(NamedTuple):
    """All sections of calibration.yaml."""

    objects: Terms  #: Utility of a pose by its objects
    #: Share of each class among the objects of any building; classes not listed are rare
    common: Terms
    keyframes: Terms  #: Utility of a pose by the points of keyframes
    #: Log odds that a recognized place is real, not a picture of it
    genuine: Terms
    attitude: Terms  #: Evidence of the attitude against a pose
    #: Evidence against a pose whose matches are all one small group
    group: Terms
    mirror: Terms  #: Search for a pose of the mirrored image
    places: Terms  #: Log odds between places that look alike
    twins: Terms  #: Conditions for two places of a map to look alike
    prior: Terms  #: Log odds of a pose outside the prior region
    search: Terms  #: How thorough a search must be for its pose to be accepted
    refusals: Terms  #: Choice of the cause that a refusal names
    looks: Terms  #: Agreement of successive looks
    links: Terms  #: Odds that odometry links successive instants
    camera: Terms  #: Errors of a camera and its boxes, and their limits
    covariance: Terms  #: Weights of covariances
    watch: Terms  #: Log odds of a look of the watch, and how looks are combined
    images: Terms  #: Faults of a camera that its images show
    turn: Terms  #: Rotation of a camera against its stated mount
    depth: Terms  #: Limits of plausible depths


#: The installed numbers. A missing or unknown section is a defect of the installation.
CALIBRATION = Calibration(**{
    name: Terms({term: entry['value'] for term, entry in section['terms'].items()})
    for name, section in yaml.safe_load(FILE.read_text()).items()})
