# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What makes queries fail: ``python -m studies.blame --help``.

The true pose is refined on the boxes of its query like any hypothesis, and compared with what the
search found. The first of these that holds is to blame:

objects     the true pose explains fewer objects than a sample needs
map         refinement leads the true pose away from the truth
candidates  too few of the pairs that it explains are correspondence candidates
choice      the search found a right pose, or the best one has more support than the true one
search      the true pose has more support than any that the search found

The last column counts failing queries with five or more objects whose true landmark is a candidate
of a box: there association allows a right pose. In several images an object counts once.
"""

import argparse
import sys
from collections import Counter
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.confidence import Support, tilt_handicaps, utilities
from cliploc_ros.core.acceptance.contenders import (
    contenders_of,
    join_frames,
    refined,
    unrefined,
)
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.trials import PosedQuery
from studies.acceptance.places import MODES, add_arguments, chosen_places
from studies.reports import table

CAUSES = ('objects', 'map', 'candidates', 'search', 'choice')
_MATCHINGS = {'hybrid': 'labels', 'class': 'classes'}
_MANY = 5


class Blame(NamedTuple):
    """What makes a query fail."""

    cause: str  #: One of CAUSES; empty if the query does not fail
    #: Number of landmarks that are correspondence candidates of a box that shows them
    candidates: int


def blame(landmark_map: LandmarkMap, relocalizer: Relocalizer, query: PosedQuery, limit_m: float
          ) -> Blame:
    """Return what makes a query fail.

    Parameters
    ----------
    relocalizer : Relocalizer
        Of this map.
    limit_m : float
        A pose within this distance of the truth is right [m].
    """
    frames = [relocalizer.search(one) for one in (*query.neighbours, query.observation)]
    found = relocalizer.locate(frames)
    errors = [pose_error(hypothesis.map_from_camera, query.map_from_camera)[0]
              for hypothesis in found.hypotheses]
    joined = join_frames(landmark_map, relocalizer.options, frames)
    true, = contenders_of(joined, [refined(joined, unrefined(query.map_from_camera))], [True])
    candidates = [{one.landmark for one in its
                   if [one.detection, one.landmark] in frame.scene.pairs.tolist()}
                  for frame, its in zip(frames, true.matches, strict=True)]
    least = frames[-1].sample_size
    if errors and errors[0] <= limit_m:
        cause = ''
    elif len(true.landmarks) < least:
        cause = 'objects'
    elif pose_error(true.pose, query.map_from_camera)[0] > limit_m:
        cause = 'map'
    elif max(map(len, candidates)) < least:
        cause = 'candidates'
    elif any(error <= limit_m for error in errors):
        cause = 'choice'
    else:
        best = [(one.support, one.map_from_camera) for one in found.hypotheses[:1]]
        leads = [_lead(*one, relocalizer.options) for one in ((true.support, true.pose), *best)]
        cause = 'search' if int(np.argmax(leads)) == 0 else 'choice'
    return Blame(cause, len(set().union(*candidates)))


def _lead(its: Support, pose: NDArray[np.float64], options: RelocalizerOptions) -> float:
    """Return the utility by which a pose is chosen."""
    handicap = tilt_handicaps(pose[None], options.tilt_deviation_deg)
    return float((utilities([its]) - handicap)[0])


def run(arguments: list[str]) -> int:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(prog='blame', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.set_defaults(frames='main')
    parser.add_argument('--matching', nargs='+', choices=_MATCHINGS, default=list(_MATCHINGS))
    parser.add_argument('--limit', type=float, default=0.5, metavar='M',
                        help='error of a right pose (%(default)s)')
    options = parser.parse_args(arguments)
    places = [chosen_place.load() for chosen_place in chosen_places(options)]
    rows = []
    for matching, mode in product(options.matching, MODES):
        found = []
        for place in tqdm(places, f'{matching}, {mode}', disable=None):
            relocalizer = Relocalizer(place.landmark_map, place.options(
                mode, RelocalizerOptions(matching=matching)))
            queries = place.ask(mode) if mode in place.modes else []
            found += [blame(place.landmark_map, relocalizer, query, options.limit)
                      for query in queries]
        counts = Counter(one.cause for one in found)
        rows.append([_MATCHINGS[matching], mode, len(found), *(
            counts[cause] for cause in ('', *CAUSES)), sum(
                bool(one.cause) and one.candidates >= _MANY for one in found)])
    print(table(['by', 'known', 'queries', f'right within {options.limit:g} m', *CAUSES,
                 f'fail with {_MANY} candidates or more'], rows))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
