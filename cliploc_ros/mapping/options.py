# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How to build a map: every choice that mapping leaves to its user."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MappingOptions:
    """Options of mapping.

    Parameters
    ----------
    edge_sigma_px, edge_sigma_share : float
        Standard deviation of a box's edge: [px], and as a share of the box's extent; both are
        added in squares.
    border_px : float
        An edge this near to the image border is open: the object may extend beyond it [px].
    pairs_per_box : int
        Hypotheses that each box is the seed of.
    min_viewpoints : int
        A landmark needs support from so many viewpoints.
    random_seed : int
        Equal seed and input give equal output.
    """

    edge_sigma_px: float = 2.0
    edge_sigma_share: float = 0.04
    border_px: float = 3.0
    pairs_per_box: int = 3
    min_viewpoints: int = 3
    random_seed: int = 0
