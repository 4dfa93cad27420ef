# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether odometry links the frames of several instants, as far as their objects tell.

Odometry does not see a robot that is carried, and a robot whose wheels slip. Frames from before
then show another place. A pose of all frames would be theirs, whatever the newest image shows. A
link is therefore a hypothesis: with prior odds against a break in each gap between two instants,
and with the evidence of the frames on both sides of the gap for a common pose.

Let U be the utility of a pose by the frames of one side, and N that of no pose being right, see
cliploc_ros.core.acceptance.confidence. Frames support a pose by

    S = U(pose) - log(1 + sum over their own poses p of exp(U(p) - N)),

which is 0 for frames without objects, at most N, and low for frames that contradict the pose or
fit another pose better. Two sides that are not linked have independent poses. The log odds of a
link are therefore prior + S(after) + S(before) - N. If it does not hold, the pose is right with
the probability exp(S(after) - N) that the frames after the gap give it alone. The sum is computed
for the newest instant, whose pose is asked for. The other sides are limited to N.

The cameras of one instant are mounted on one robot. They need no odometry.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.comparison import Comparison
from cliploc_ros.core.acceptance.contenders import Contender, JoinedFrames, join_frames, unrefined
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_LOOK, invert_transform
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.units import NS_PER_S


class Link(NamedTuple):
    """The weakest link between the instants of some frames."""

    holds: float = 1.0  #: Probability that the frames on both sides have a common pose
    chance: float = 1.0  #: Probability, at most that of any link, that the frames after it have it
    kept: int = 0  #: Number of last frames, which are those after this link


def weakest_link(joined: JoinedFrames, pose: NDArray[np.float64], seen: Recognition | None,
                 meet: Callable[[JoinedFrames], Sequence[Contender]]) -> Link:
    """Return the weakest link of the frames, given the pose (4, 4) of the last one.

    `seen` has the places of the newest image by keyframes. `meet` returns the best poses of some
    of the frames, see search_contenders.
    """
    instants, stamps = joined.instants, [frame.observation.stamp_ns for frame in joined.frames]
    starts = [row for row in range(1, len(stamps)) if instants[row] != instants[row - 1]]
    if not starts:
        return Link()
    none, terms = joined.none_right, CALIBRATION.links

    def part(first: int, end: int) -> tuple[JoinedFrames, NDArray[np.float64], float]:
        """Return some of the frames, the pose of their last camera, and its utility."""
        frames: Sequence[SearchedFrame] = joined.frames[first:end]
        own = join_frames(joined.landmark_map, joined.options, frames)
        its = pose @ invert_transform(joined.cameras[end - 1])
        # odometry is not exact
        fits = [unrefined(its), own.refined(unrefined(its))]
        fits = [fit for fit in fits if SAME_LOOK.agree(fit.map_from_camera, its)]
        # the support of a pose without matches does not count unexplained objects
        index = joined.landmark_map.classes
        lost = CALIBRATION.objects.unexplained * sum(
            index.are_own(index.classes_of(frame.observation.detections.class_ids)).sum()
            for frame in frames) / len(frames)
        return own, its, max(fit.odds if fit.support.inliers else lost for fit in own.contenders(
            fits, [True] * len(fits)))

    newest, its, utility = part(starts[-1], len(stamps))
    met = meet(newest)
    others = [*met, *(Comparison(newest, met).proposed(seen, met) if seen else ())]
    agree = [SAME_LOOK.agree(other.pose, its) for other in others]
    here = max([utility, *(other.odds for other, same in zip(others, agree, strict=True) if same)])
    missed = float(np.logaddexp.reduce([none, here, *(
        other.odds for other, same in zip(others, agree, strict=True) if not same)])) - none
    links = []
    for start in starts:
        after = here if start == starts[-1] else part(start, len(stamps))[2]
        before = part(0, start)[2]
        gap_s = abs(stamps[start] - stamps[start - 1]) / NS_PER_S
        # an earlier link held when its instant was the newest one
        broken = terms.broken if start == starts[-1] else terms.broken_before
        broken = min(terms.most_broken, broken + terms.broken_per_s * gap_s)
        supported = min(none, after - missed)
        log_odds = math.log(1.0 / broken - 1.0) + supported + min(none, before) - none
        holds = 1.0 / (1.0 + math.exp(-max(log_odds, -50.0)))
        links.append(Link(holds, holds + (1.0 - holds) * math.exp(supported - none),
                          len(stamps) - start))
    return min(links)._replace(chance=min(link.chance for link in links))
