# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide whether a pose is accepted: calibration.yaml, a tuple a section."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

FILE = Path(__file__).with_name('calibration.yaml')


class Objects(NamedTuple):
    """Utility of a pose by its objects."""

    score: float
    misfit: float
    likeness: float
    rarity: float
    unlabelled: float
    unexplained: float
    depth: float
    none_right: float
    map_size: float
    least_size: float
    vertical: float
    knee: float
    slope: float


class Keyframes(NamedTuple):
    """Utility of a pose by the points of keyframes."""

    none: float
    inliers: float
    confirmed: float
    most: float
    explained: float
    unexplained: float
    most_objects: float
    missed: float
    good_covariance: float


class Genuine(NamedTuple):
    """Log odds that a recognized place is there, and no picture of it."""

    none: float
    points: float
    confirmed: float
    focal: float
    aspect: float
    reach: float
    unexplained: float
    rival: float
    most_motion: float


class Attitude(NamedTuple):
    """The evidence of an attitude against a pose."""

    wrong_mount: float
    not_mirrored: float
    vertical_sigmas: float


class Places(NamedTuple):
    """Log odds between places that look alike."""

    likeness: float
    unlabelled: float
    aged: float
    rooms: float


class Prior(NamedTuple):
    """What a region says."""

    most: float
    least_m: float
    least_deg: float


class Search(NamedTuple):
    """When a search is enough."""

    least_samples: float
    missed_is_right: float
    early_share: float


class SuccessiveLooks(NamedTuple):
    """What successive looks must agree on."""

    mean_confidence: float
    most: int
    drift_m: float
    drift_deg: float


class SystematicErrors(NamedTuple):
    """Errors of a camera and its boxes, and when they are too large."""

    wrong: float
    sure: float
    view: float
    extent: float
    focal: float
    aspect: float
    point: float
    calibrated: float
    corner: float
    size: float


class Spread(NamedTuple):
    """How covariances count."""

    caution: float
    sharpness: float
    most_confidence: float


class Looking(NamedTuple):
    """Log odds of a look of the watch, and how its looks add up."""

    none: float
    utility: float
    any: float
    unexplained: float
    missed: float
    away: float
    aged: float
    turned: float
    crowd: float
    least: float
    least_unsure: float
    most: float
    lost_per_s: float
    lost_per_m: float
    correlated: float
    correlated_m: float
    correlated_deg: float
    correlated_s: float
    most_jump: float
    lost: float
    localized: float


class Calibration(NamedTuple):
    """All sections; calibration.yaml says what each number means."""

    objects: Objects
    #: Share of each class among the things of any building; classes that are missing are rare
    common: Mapping[str, float]
    keyframes: Keyframes
    genuine: Genuine
    attitude: Attitude
    places: Places
    prior: Prior
    search: Search
    looks: SuccessiveLooks
    camera: SystematicErrors
    covariance: Spread
    watch: Looking


def load_calibration(path: Path = FILE) -> Calibration:
    """Read the numbers; a missing or unknown one is a defect of the installation."""
    sections: dict[str, Any] = yaml.safe_load(path.read_text())
    kinds: dict[str, Any] = Calibration.__annotations__ | {'common': dict}
    return Calibration(**{
        name: kind(**{term: entry['value'] for term, entry in sections[name]['terms'].items()})
        for name, kind in kinds.items()})


#: The installed numbers.
CALIBRATION = load_calibration()
