# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What errors of the poses leave in a map: of each landmark, and of all that are near each other.

Refinement makes poses and landmarks agree. The mean error of the poses that saw a part of the map
stays: it displaces and turns this part as a whole. Errors of a stationary process of deviation
sigma that forgets itself as exp(-|t - s| / tau) have a mean over n frames of variance

    sigma^2 / n_eff,   1 / n_eff = sum of exp(-|t_i - t_j| / tau) over i and j, over n^2.

A landmark's part of the map are the landmarks that some frame shows together with it, and the
frames that saw any of them.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.mapping.landmarks import group_boxes
from cliploc_ros.mapping.options import PoseErrors
from cliploc_ros.mapping.views import Views

# Errors of poses in one span of time are alike, the default of PoseErrors.correlation_s [s].
_POSE_ERROR_S = 3.0
# Boxes that are matched wrongly before the poses are refined bend the map: parts of it are off by
# this many times the mean error of their poses. Chosen on maps of TUM fr3 from poses off by 5
# and 10 cm over 3 s (seeds 0 to 4 of studies/speed/pose_errors.py).
_BENDING = 1.6


def left_by_poses(views: Views, changes: NDArray[np.float64], shown: NDArray[np.int64],
                  count: int) -> NDArray[np.float64]:
    """Return by how much errors of the poses displace each landmark on each axis (count,) [m].

    What a landmark's frames have in common stays: the mean of as many independent errors as there
    are spans of time in which it was seen.

    Parameters
    ----------
    changes : ndarray (F, 6)
        Squares of what refinement changed; 0 where the poses were taken as they are.
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    count : int
        Number of landmarks.
    """
    squares = np.zeros(count)
    for row, boxes in enumerate(group_boxes(shown, count)):
        frames = np.unique(views.frames[boxes])
        spans = len(np.unique(views.stamps_s[frames] // _POSE_ERROR_S))
        if spans:
            squares[row] = changes[frames, :3].mean() / spans
    return np.sqrt(squares)


def shared_by_neighbours(views: Views, shown: NDArray[np.int64], count: int, errors: PoseErrors
                         ) -> NDArray[np.float64]:
    """Return by how much each landmark's part of the map is off as a whole (count, 2) [m] [deg].

    On each axis. The part is displaced, and turned about the cameras that saw it.

    Parameters
    ----------
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    count : int
        Number of landmarks.
    errors : PoseErrors
        Of the poses that were refined.
    """
    rows = np.nonzero(shown >= 0)[0]
    seen = csr_matrix((np.ones(len(rows), dtype=np.int32), (views.frames[rows], shown[rows])),
                      shape=(len(views.rotations), count))
    # frames (F, L) that saw a landmark which is seen together with each
    near = (seen @ ((seen.T @ seen) > 0).astype(np.int32)).tocsc()
    near.sort_indices()
    shares = np.array([_share_left(
        views.stamps_s[frames], views.weights[frames], errors.correlation_s)
        for frames in np.split(near.indices, near.indptr[1:-1])])
    return np.asarray(_BENDING * np.sqrt(shares)[:, None] * [errors.sigma_m, errors.sigma_deg])


@compiled
def _share_left(stamps_s, weights, correlation_s):
    """Return the share of the variance that the weighted mean of some errors keeps.

    Stamps ascend.
    """
    before, total, squares = 0.0, 0.0, 0.0
    for place in range(len(stamps_s)):
        if place > 0:
            step = stamps_s[place] - stamps_s[place - 1]
            kept = np.exp(-step / correlation_s) if correlation_s > 0.0 else 0.0
            before = kept * (before + weights[place - 1])
        squares += weights[place] * (weights[place] + 2.0 * before)
        total += weights[place]
    return squares / (total * total) if total > 0.0 else 1.0
