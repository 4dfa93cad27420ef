# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The confidence of each pose: what supports it, weighed against what supports the others.

A conditional logit (McFadden, "Conditional Logit Analysis of Qualitative Choice Behavior", 1974):
each distinct pose has a utility, linear in its support. So has the case that none of them is
right: the more landmarks the map has, the more wrong poses fit by chance; a known vertical leaves
fewer. Probabilities are proportional to the exponentials of the utilities, so the poses of an
ambiguous scene share the probability. Poses that agree (1 m, 45 degrees) add up theirs.

The search of objects chooses its poses among many by their support. Keyframes propose theirs by
points: what the objects say of such a pose counts from the utility of none being right, whatever
the size of the map. Points and objects that lead to one place add up theirs: by chance, features
and boxes do so independently. Where they see one picture, see
cliploc_ros.core.acceptance.genuine.

Where the robot probably is, a region, is evidence, never a cut. A region is right with its
probability p; otherwise the robot may be anywhere in the map. So a pose has the density
p N(pose) + (1 - p) u, where u is uniform over the map. Its logarithm over u is bounded: 0 in the
region, a constant elsewhere. So a region never raises a pose against the case that no pose is
right, and lifts none that its objects support weakly: the confidence of a pose stays below that
without its rivals. Nor does it decide alone between two places that look the same: the robot may
have been told the wrong one of them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION, Calibration
from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.geometry.transforms import SAME_ANSWER
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Region

# Deviations [deg] of the best vertical that the fit has seen, and of one that is no help.
_BEST_VERTICAL_DEG, _VAGUE_VERTICAL_DEG = 0.5, 45.0
# A robot drives about beyond the outermost landmarks, too [m].
_MARGIN_M = 1.0
# A body that points up or down has no yaw: of its x axis, this much must be level.
_LEAST_AHEAD = 0.5


class Setting(NamedTuple):
    """The setting of a pose: besides the supports, the chance of a wrong pose depends on it."""

    landmarks: int  #: Number of landmarks in the map
    #: Standard deviation of the known vertical [deg]; infinite where none is known
    vertical_deg: float = math.inf

    @property
    def map_size(self) -> float:
        """Return the logarithm of the number of landmarks.

        Boxes may show all things of the building: a small map lacks some that look like its own.
        """
        return math.log(max(CALIBRATION.objects.least_size, self.landmarks))

    @property
    def vertical(self) -> float:
        """Return the log of the attitudes that it rules out: 3.8 to 1 degree, 0 for none."""
        return math.log(_VAGUE_VERTICAL_DEG / min(max(self.vertical_deg, _BEST_VERTICAL_DEG),
                                                  _VAGUE_VERTICAL_DEG))


def confidences(odds: NDArray[np.float64], poses: NDArray[np.float64], none: float,
                calibration: Calibration = CALIBRATION,
                prior: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the probability (m,) that each pose (m, 4, 4) is within 1 m of the truth.

    The rest to 1 is the probability that another pose is right, or none. Odds (m,) are the
    utilities of the poses, none is that of the case that none of them is right. The prior (m,)
    is log odds of 0 or less, so it raises no pose against none.
    """
    if len(odds) == 0:
        return np.empty(0)
    most = calibration.covariance.most_confidence
    shares = np.exp(np.append(odds, none) - max(odds.max(), none))
    shares = shares[:-1] / shares.sum()
    agreeing = SAME_ANSWER.agreeing(poses)
    likely = np.clip(agreeing @ shares, 1.0 - most, most)
    log_odds = np.log(likely / (1.0 - likely))
    log_odds += calibration.objects.slope * np.maximum(0.0, log_odds - calibration.objects.knee)
    sharpened = 1.0 / (1.0 + np.exp(-log_odds))
    lead = int(np.argmax(likely))
    # the other places lose what the leading place gains
    lost = (1.0 - sharpened[lead]) / (1.0 - likely[lead])
    if prior is None or not prior.any():
        return np.minimum(np.where(agreeing[lead], sharpened, likely * lost), most)
    # what the prior says of each pose is no evidence of objects, and not steepened
    kept = np.where(agreeing[lead], sharpened[lead] / likely[lead], lost)
    weighted = shares * kept * np.exp(prior)
    none_of_them = max(0.0, 1.0 - float(shares @ kept))
    return np.minimum(agreeing @ weighted / (weighted.sum() + none_of_them), most)


def utilities(supports: Sequence[Support], calibration: Calibration = CALIBRATION
              ) -> NDArray[np.float64]:
    """Return the utility (m,) of each support by objects: its log odds, up to a constant."""
    terms = calibration.objects
    return np.array([
        terms.score * one.score + terms.misfit * one.misfit + terms.likeness * one.likeness
        + terms.rarity * one.rarity + terms.unlabelled * one.unlabelled
        + terms.unexplained * one.unexplained + terms.depth * one.depth for one in supports])


def none_right(setting: Setting, calibration: Calibration = CALIBRATION) -> float:
    """Return the utility of the case that no pose is right."""
    terms = calibration.objects
    return (terms.none_right + terms.map_size * setting.map_size
            + terms.vertical * setting.vertical)


def points_utility(place: RecognizedPlace, calibration: Calibration = CALIBRATION) -> float:
    """Return the evidence of its points for a place: log odds, against a place by chance."""
    terms = calibration.keyframes
    return min(terms.most, terms.none + terms.inliers * math.log(max(1, place.inliers))
               + terms.confirmed * place.confirmed)


def objects_utility(support: Support, calibration: Calibration = CALIBRATION) -> float:
    """Return what objects say of a pose that keyframes propose: log odds, against none."""
    terms = calibration.keyframes
    return (terms.explained * min(terms.most_objects, support.inliers)
            + terms.unexplained * min(terms.most_objects, support.unexplained))


def tilt_handicaps(map_from_cameras: NDArray[np.float64], deviation_deg: float
                   ) -> NDArray[np.float64]:
    """Return the log odds (m,) that the tilt of each camera takes from its pose, 0 to 4.6.

    Parameters
    ----------
    map_from_cameras : ndarray (m, 4, 4)
        Poses in a map whose third axis is up.
    deviation_deg : float
        Standard deviation of the tilt [deg], see RelocalizerOptions; 0 for none.
    """
    if deviation_deg == 0.0:
        return np.zeros(len(map_from_cameras))
    deviation = np.radians(deviation_deg)
    # the optical frame's second axis is down
    tilts = np.arccos(np.clip(-map_from_cameras[:, 2, 1], -1.0, 1.0))
    against = 0.5 * (tilts / deviation) ** 2 - np.log(2.0 / deviation ** 2)
    return np.clip(against, 0.0, CALIBRATION.attitude.wrong_mount)


def region_odds(landmark_map: LandmarkMap, region: Region, poses: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """Return the log odds (m,), 0 or less, that a region gives to camera poses (m, 4, 4) of a map.

    A region of a map that is not there says nothing.
    """
    parts = parts_of(landmark_map)
    shift = next((one.shift for one in parts if one.landmark_map.frame_id == region.frame_id),
                 None)
    if shift is None:
        return np.zeros(len(poses))
    terms = CALIBRATION.prior
    bodies = poses @ region.camera_from_body
    steps = np.c_[bodies[:, :2, 3] - shift[:2], np.arctan2(bodies[:, 1, 0], bodies[:, 0, 0])]
    steps -= region.mean
    steps[:, 2] = (steps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    steps[np.hypot(*bodies[:, :2, 0].T) < _LEAST_AHEAD, 2] = 0.0
    covariance = region.covariance + np.diag(
        [terms.least_m, terms.least_m, math.radians(terms.least_deg)]) ** 2
    spot, yaw = covariance[:2, :2], covariance[2, 2]
    squares = (np.einsum('ni,ij,nj->n', steps[:, :2], np.linalg.inv(spot), steps[:, :2])
               + steps[:, 2] ** 2 / yaw)
    area = sum(float(np.prod(np.ptp(one.landmark_map.centers[:, :2], axis=0) + 2.0 * _MARGIN_M))
               for one in parts)
    # a region wider than the map is as good as the map
    peak = (max(0.0, math.log(area / (2.0 * math.pi)) - 0.5 * np.linalg.slogdet(spot)[1])
            + max(0.0, 0.5 * math.log(2.0 * math.pi / yaw)))
    p = min(max(region.probability, 1e-9), 1.0 - 1e-9)
    odds = np.logaddexp(math.log(1.0 - p), math.log(p) + peak - 0.5 * squares)
    return np.asarray(np.clip(odds, -terms.most, 0.0))
