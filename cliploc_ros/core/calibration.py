# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide whether a pose is accepted or doubted: calibration.yaml."""

from pathlib import Path
from typing import NamedTuple

import yaml

FILE = Path(__file__).with_name('calibration.yaml')


class Terms(dict[str, float]):
    """The numbers of a section by their names; calibration.yaml says what each means."""

    def __getattr__(self, name: str) -> float:
        """Return a number."""
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f'calibration.yaml has no {name} here') from None

    def _replace(self, **numbers: float) -> 'Terms':
        """Return the section with other numbers."""
        return Terms(self | numbers)


class Calibration(NamedTuple):
    """All sections."""

    objects: Terms  #: Utility of a pose by its objects
    #: Share of each class among the things of any building; classes that are missing are rare
    common: Terms
    keyframes: Terms  #: Utility of a pose by the points of keyframes
    #: Log odds that a recognized place is real, not a picture of it
    genuine: Terms
    attitude: Terms  #: The evidence of an attitude against a pose
    mirror: Terms  #: Search for a pose of the mirrored image
    places: Terms  #: Log odds between places that look alike
    twins: Terms  #: Limits within which places of a map look alike
    prior: Terms  #: Log odds of a pose outside the region of the prior
    search: Terms  #: Condition that ends a search
    refusals: Terms  #: Choice of the cause that a refusal names
    looks: Terms  #: Agreement of successive looks
    camera: Terms  #: Errors of a camera and its boxes, and when they are too large
    covariance: Terms  #: Weights of covariances
    watch: Terms  #: Log odds of a look of the watch, and how its looks add up
    images: Terms  #: Faults of a camera by its images
    turn: Terms  #: Turn of a camera against its mount
    depth: Terms  #: Limits of plausible depths


#: The installed numbers; a missing or unknown section is a defect of the installation.
CALIBRATION = Calibration(**{
    name: Terms({term: entry['value'] for term, entry in section['terms'].items()})
    for name, section in yaml.safe_load(FILE.read_text()).items()})
