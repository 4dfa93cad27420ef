# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the causes of failed queries: ``python -m studies.blame --help``.

The true pose is refined on the boxes of its query like any hypothesis, and compared with the
result of the search. The cause is the first of these that applies:

objects     the true pose explains fewer objects than a sample needs
map         refinement moves the true pose away from the truth
candidates  too few of the pairs that it explains are correspondence candidates
choice      the search found a correct pose, or its best pose has more support than the true pose
search      the true pose has more support than all poses that the search found

The last column counts failed queries with five or more objects whose true landmark is a candidate
of a box: their association allows a correct pose. An object in several images counts once.
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
from cliploc_ros.core.acceptance.contenders import join_frames, unrefined
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.posed_query import PosedQuery
from studies.acceptance.places import MODES, add_arguments, chosen_places
from studies.reports import table

CAUSES = ('objects', 'map', 'candidates', 'search', 'choice')
_MATCHINGS = {'hybrid': 'labels', 'class': 'classes'}
_MANY = 5


class Blame(NamedTuple):
    """The cause of a failed query."""

    cause: str  #: One of CAUSES; empty if the query does not fail
    #: Number of landmarks that are correspondence candidates of a box that shows them
    candidates: int


def blame(landmark_map: LandmarkMap, relocalizer: Relocalizer, query: PosedQuery, limit_m: float
          ) -> Blame:
    """Return the cause of a failed query.

    Parameters
    ----------
    relocalizer : Relocalizer
        Relocalizer of this map.
    limit_m : float
        A pose within this distance of the truth is correct [m].
    """
    frames = [relocalizer.search(observation)
              for observation in (*query.neighbours, query.observation)]
    found = relocalizer.locate(frames)
    errors = [pose_error(hypothesis.map_from_camera, query.map_from_camera)[0]
              for hypothesis in found.hypotheses]
    joined = join_frames(landmark_map, relocalizer.options, frames)
    true, = joined.contenders([joined.refined(unrefined(query.map_from_camera))], [True])
    candidates = [{match.landmark for match in matches
                   if [match.detection, match.landmark] in frame.scene.pairs.tolist()}
                  for frame, matches in zip(frames, true.matches, strict=True)]
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
        best = [(hypothesis.support, hypothesis.map_from_camera)
                for hypothesis in found.hypotheses[:1]]
        leads = [_lead(*pose, relocalizer.options) for pose in ((true.support, true.pose), *best)]
        cause = 'search' if int(np.argmax(leads)) == 0 else 'choice'
    return Blame(cause, len(set().union(*candidates)))


def _lead(support: Support, pose: NDArray[np.float64], options: RelocalizerOptions) -> float:
    """Return the utility of a pose, by which the search chooses."""
    handicap = tilt_handicaps(pose[None], options.tilt_deviation_deg)
    return float((utilities([support]) - handicap)[0])


def run(arguments: list[str]) -> int:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(prog='blame', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.set_defaults(frames='main')
    parser.add_argument('--matching', nargs='+', choices=_MATCHINGS, default=list(_MATCHINGS))
    parser.add_argument('--limit', type=float, default=0.5, metavar='M',
                        help='greatest error of a correct pose (%(default)s)')
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
        counts = Counter(outcome.cause for outcome in found)
        rows.append([_MATCHINGS[matching], mode, len(found), *(
            counts[cause] for cause in ('', *CAUSES)), sum(
                bool(outcome.cause) and outcome.candidates >= _MANY for outcome in found)])
    print(table(['by', 'known', 'queries', f'right within {options.limit:g} m', *CAUSES,
                 f'fail with {_MANY} candidates or more'], rows))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
