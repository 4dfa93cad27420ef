# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How probable it is that an object is still in its place.

Of N viewpoints that show the place, K show the object. If it is there, K is binomial with a ratio
that is a beta variable: about the ratio at which it was seen before, with few views' worth of
certainty, since some objects are hard to see from one side; the landmarks that were seen tell how
few. If it is not there, K counts wrong
boxes only. Both with the prior that most objects stay give the probability.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, expit

from cliploc_ros.mapping.updating.known import Known
from cliploc_ros.mapping.updating.options import UpdateOptions
from cliploc_ros.mapping.updating.sight import Sight

# A recording in which objects are seen more rarely or more often than before changes all ratios.
_FACTOR_RANGE = (0.3, 2.0)
_RATIO_RANGE = (0.02, 0.95)
# Landmarks and viewpoints of each from which the scatter of the ratio is learned, and the least
# that a usual ratio is worth [views]. Guesses.
_MEDIAN_SQUARE = 0.455  # of a standard normal variable
_FEW_LANDMARKS, _FEW_VIEWS, _LEAST_VIEWS = 5, 3, 0.5


def probability_there(sight: Sight, ratios: NDArray[np.float64], options: UpdateOptions
                      ) -> NDArray[np.float64]:
    """Return for each place (L,) the probability that its object is there.

    Parameters
    ----------
    sight : Sight
    ratios : ndarray (L,)
        Share of the views in which each object is usually detected.
    options : UpdateOptions
    """
    there = _log_evidence(sight, ratios, _certainty(sight, ratios, options))
    away = _log_evidence(sight, np.full(len(ratios), options.chance_ratio), options.prior_views)
    return np.asarray(expit(np.log(options.stays / (1.0 - options.stays)) + there - away))


def _log_evidence(sight: Sight, ratios: NDArray[np.float64], views: float) -> NDArray[np.float64]:
    """Return the logarithm of the beta-binomial probability, without the binomial coefficient."""
    a, b = views * ratios, views * (1.0 - ratios)
    return np.asarray(betaln(a + sight.seen, b + sight.expected - sight.seen) - betaln(a, b))


def _certainty(sight: Sight, ratios: NDArray[np.float64], options: UpdateOptions) -> float:
    """Return how many views the usual ratios are worth: few if this recording scatters about them.

    A beta variable of mean r and n views has the variance r (1 - r) / (n + 1).
    """
    rows = (sight.seen > 0) & (sight.expected >= _FEW_VIEWS)
    if np.count_nonzero(rows) < _FEW_LANDMARKS:
        return options.prior_views
    shares, usual = sight.seen[rows] / sight.expected[rows], ratios[rows]
    # the median, since objects that are gone are no scatter
    scatter = np.median(np.square(shares - usual) / (usual * (1.0 - usual))) / _MEDIAN_SQUARE
    return float(np.clip(1.0 / max(float(scatter), 1e-3) - 1.0, _LEAST_VIEWS, options.prior_views))


def usual_ratios(known: Known, sight: Sight, options: UpdateOptions) -> NDArray[np.float64]:
    """Return the share of views (L,) in which this recording should show each old landmark.

    It is the share of the old recording, times how much more often the new one shows all objects;
    without an old one, the share of the landmarks seen in this recording.
    """
    seen = sight.seen > 0
    share = float(sight.seen[seen].sum()) / max(1.0, float(sight.expected[seen].sum()))
    overall = min(options.seen_ratio, share)
    given = np.array([np.nan if one.seen_ratio is None else one.seen_ratio
                      for one in known.details])
    ratios = np.where(np.isnan(given), overall, given)
    told = seen & ~np.isnan(given)
    if told.any():
        expected = float((given[told] * sight.expected[told]).sum())
        factor = np.clip(sight.seen[told].sum() / max(expected, 1e-9), *_FACTOR_RANGE)
        ratios = np.where(np.isnan(given), ratios, factor * ratios)
    return np.clip(ratios, *_RATIO_RANGE)
