# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The confidence of each hypothesis: the support of a pose, weighed against that of the others.

A conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice Behavior", 1974):
each distinct hypothesis has a utility, linear in its support. So has the case that none of them
is right: the more landmarks the map has, the more wrong poses fit by chance; a known vertical
leaves fewer. Probabilities are proportional to the exponentials of the utilities, so the poses of
an ambiguous scene share the probability. Poses that agree (1 m, 45 degrees) add up theirs.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.geometry.tolerances import SAME_ANSWER

# Deviations [deg] of the best vertical that the fit has seen, and of one that is no help.
_BEST_VERTICAL_DEG, _VAGUE_VERTICAL_DEG = 0.5, 45.0
#: The data are too few to justify a higher confidence.
MOST_CONFIDENCE = 0.9999


class Setting(NamedTuple):
    """What the chance of a wrong pose depends on, besides the supports.

    Parameters
    ----------
    landmarks : int
        Number of landmarks in the map.
    vertical_deg : float
        Standard deviation of the known vertical [deg]; infinite where none is known.
    """

    landmarks: int
    vertical_deg: float = math.inf

    @property
    def map_size(self) -> float:
        """Return the logarithm of the number of landmarks."""
        return math.log(max(1, self.landmarks))

    @property
    def vertical(self) -> float:
        """Return what the vertical rules out: 0 where none is known, 3.8 for one to 1 degree."""
        return math.log(_VAGUE_VERTICAL_DEG / min(max(self.vertical_deg, _BEST_VERTICAL_DEG),
                                                  _VAGUE_VERTICAL_DEG))


class Calibration(NamedTuple):
    """The coefficients; ``python -m cliploc_ros.evaluation.worlds.fit`` fits them.

    Parameters
    ----------
    score, misfit, likeness, rarity, unlabelled, unexplained, below : float
        Utility of a unit of each kind of support.
    none_right, map_size, vertical : float
        Utility of the case that no hypothesis is right: a constant, and a unit of each part of
        the setting.
    knee, slope : float
        Log odds beyond the knee grow by 1 + slope: where all other poses have hardly any
        support, wrong poses are rarer than the tail of a logit.
    """

    score: float
    misfit: float
    likeness: float
    rarity: float
    unlabelled: float
    unexplained: float
    below: float
    none_right: float
    map_size: float
    vertical: float
    knee: float
    slope: float


#: The data that DEFAULT is fitted on. Figures measured on them are not held out.
FITTED_ON = 'simulated rooms, offices, shops and bare rooms (24 of each)'
#: Fitted with and without what else is known, and in maps whose objects have exchanged places; by
#: labels and classes, and by classes alone.
DEFAULT = Calibration(score=1.72, misfit=-0.274, likeness=0.465, rarity=0.347, unlabelled=0.756,
                      unexplained=-0.797, below=0.0, none_right=0.92, map_size=1.44,
                      vertical=-0.666, knee=2.0, slope=0.0)


def confidences(supports: Sequence[Support], poses: NDArray[np.float64], setting: Setting,
                calibration: Calibration = DEFAULT,
                handicaps: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    """Return the probability that each hypothesis is within 1 m of the truth.

    Parameters
    ----------
    supports : sequence of m Support
    poses : ndarray (m, 4, 4)
        map_from_camera of the same hypotheses.
    setting : Setting
    calibration : Calibration, optional
    handicaps : ndarray (m,), optional
        Log odds that speak against each hypothesis besides its support.

    Returns
    -------
    ndarray (m,)
        0 to 1. The rest to 1 is the probability that another pose is right, or none.
    """
    odds = utilities(supports, calibration) - handicaps
    none = none_right(setting, calibration)
    shares = np.exp(np.append(odds, none) - max(odds.max(), none))
    shares = shares[:-1] / shares.sum()
    agreeing = SAME_ANSWER.agreeing(poses)
    likely = np.clip(agreeing @ shares, 1.0 - MOST_CONFIDENCE, MOST_CONFIDENCE)
    log_odds = np.log(likely / (1.0 - likely))
    log_odds += calibration.slope * np.maximum(0.0, log_odds - calibration.knee)
    sharpened = 1.0 / (1.0 + np.exp(-log_odds))
    lead = int(np.argmax(likely))
    # the other places lose what the leading place gains
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), MOST_CONFIDENCE)


def utilities(supports: Sequence[Support], calibration: Calibration = DEFAULT
              ) -> NDArray[np.float64]:
    """Return the utility (m,) of each support: the logarithm of its odds, up to a constant."""
    return np.array([
        calibration.score * one.score + calibration.misfit * one.misfit
        + calibration.likeness * one.likeness + calibration.rarity * one.rarity
        + calibration.unlabelled * one.unlabelled + calibration.unexplained * one.unexplained
        + calibration.below * one.below
        for one in supports])


def none_right(setting: Setting, calibration: Calibration = DEFAULT) -> float:
    """Return the utility of the case that no hypothesis is right."""
    return (calibration.none_right + calibration.map_size * setting.map_size
            + calibration.vertical * setting.vertical)
