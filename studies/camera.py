# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Does a localizer detect a wrong camera? ``python -m studies.camera --help``.

One localizer gets all images of a recording, or of drives through simulated worlds, in order; a
new one is made for each image as well. Boxes or camera_info are wrong by one of several rules.
The map is the given one, or one that another program or a person could have made of the same
objects. The table counts accepted poses, and the images until the localizer reports the camera as
wrong.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product, takewhile

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.trials import with_vertical
from cliploc_ros.offline.mapping.building import refit_map
from cliploc_ros.offline.posed_query import PosedQuery
from studies import wrong_sensors
from studies.acceptance.places import (
    VERTICAL_DEG,
    AnyPlace,
    Halved,
    Simulated,
    add_arguments,
    chosen_places,
)
from studies.acceptance.searches import look_on
from studies.reports import Answer, answer_table, grouped
from studies.worlds.world import make_drive

#: Errors of all images, by name: a change and its level.
CAMERAS: dict[str, tuple[wrong_sensors.Change, float]] = {
    'right': (wrong_sensors.scaled_focal, 1.0),
    'focal length x 1.03': (wrong_sensors.scaled_focal, 1.03),
    'focal length x .97': (wrong_sensors.scaled_focal, 0.97),
    'focal length x 1.3': (wrong_sensors.scaled_focal, 1.3),
    'focal length x .8': (wrong_sensors.scaled_focal, 0.8),
    'K x 2': (wrong_sensors.scaled_camera, 2.0),
    'K x .5': (wrong_sensors.scaled_camera, 0.5),
    'K x 1.25': (wrong_sensors.scaled_camera, 1.25),
    'principal point + .2 widths': (wrong_sensors.shifted_center, 0.2),
    'boxes of a crop, 300 px': (wrong_sensors.middle_crop, 300.0),
    'boxes of a crop, 416 px': (wrong_sensors.middle_crop, 416.0),
    'boxes of a letterbox, 416 px': (wrong_sensors.letterboxed, 416.0),
    'fisheye as pinhole': (wrong_sensors.fisheye_boxes, 1.0),
    'boxes x .5': (wrong_sensors.scaled_boxes, 0.5),
    'boxes x 1.5': (wrong_sensors.scaled_boxes, 1.5),
    'boxes + .15 widths': (wrong_sensors.shifted_boxes, 0.15)}


def _rough(landmark_map: LandmarkMap, share: float, error_m: float, seed: int = 0) -> LandmarkMap:
    """Return a map with errors of all lengths (a share) and centres."""
    rng, count = np.random.default_rng(seed), len(landmark_map)
    return replace(
        landmark_map, centers=landmark_map.centers + rng.normal(0.0, error_m, (count, 3)),
        semi_axes=landmark_map.semi_axes * np.exp(rng.normal(0.0, share, (count, 3))))


def _spheres(landmark_map: LandmarkMap) -> LandmarkMap:
    """Return a map of spheres with the same volumes."""
    radii = np.exp(np.log(landmark_map.semi_axes).mean(axis=1, keepdims=True))
    return replace(landmark_map, semi_axes=np.tile(radii, (1, 3)))


def _by_class(landmark_map: LandmarkMap) -> LandmarkMap:
    """Return a map in which all objects of a class have one size, with centres off by 3 cm."""
    classes, order = np.array(landmark_map.class_ids), landmark_map.semi_axes.argsort(axis=1)
    lengths = np.take_along_axis(landmark_map.semi_axes, order, axis=1)
    medians = np.array([np.median(lengths[classes == name], axis=0) for name in classes])
    semi_axes = np.empty_like(lengths)
    np.put_along_axis(semi_axes, order, medians, axis=1)
    return _rough(replace(landmark_map, semi_axes=semi_axes), 0.0, 0.03)


#: Another map, fitted to the boxes that a place's own map is made of.
REFITTED = '20 %, 5 cm off, refitted'
#: Other maps of the same objects, by name.
MAPS: dict[str, Callable[[LandmarkMap], LandmarkMap]] = {
    'given': lambda given: given,
    '10 %, 3 cm off': lambda given: _rough(given, 0.1, 0.03),
    '20 %, 5 cm off': lambda given: _rough(given, 0.2, 0.05),
    'spheres': _spheres,
    'one size a class': _by_class}


@dataclass(frozen=True, kw_only=True)
class Look(Answer):
    """The answer to one image."""

    map: str
    camera: str
    localizer: str  #: 'one', or 'new' for each image
    drive: int
    is_called_wrong: bool  #: Whether the localizer has reported the camera as wrong
    is_look: bool  #: Whether the image gives a look, see camera_check


def _drive(place: AnyPlace, options: argparse.Namespace
           ) -> tuple[LandmarkMap, Sequence[PosedQuery]]:
    """Return a map, and the queries of a drive in order."""
    if isinstance(place, Simulated):
        world = make_drive(place.kind, place.seed, options.images).world
        return world.landmark_map, world.queries
    found = place.load()
    in_order = sorted(found.frames, key=lambda query: query.observation.stamp_ns)
    # query files do not hold the size of the images
    return found.landmark_map, [replace(query, observation=replace(
        query.observation, camera=replace(query.observation.camera, width=options.size[0],
                                        height=options.size[1])))
        for query in in_order[::options.every]]


def _looks(number: int, place: AnyPlace, options: argparse.Namespace) -> Iterator[Look]:
    """Yield the answers on a drive, for each of the chosen maps and cameras."""
    own, queries = _drive(place, options)
    if options.vertical:
        queries = with_vertical(queries, VERTICAL_DEG)
    for map_name in options.maps:
        if map_name != REFITTED:
            landmark_map = MAPS[map_name](own)
        elif isinstance(place, Halved):
            landmark_map = refit_map(place.halves()[0], _rough(own, 0.2, 0.05)).landmark_map
        else:
            raise OptionsError(f"'{REFITTED}' needs --observations")
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(
            k=min(3, len(own)), matching='class' if options.observations else 'hybrid'))
        for name, localizer in product(options.wrong, options.localizers):
            change, level = CAMERAS[name]
            for fields, is_called_wrong, is_look in look_on(
                    relocalizer, change(queries, level), localizer == 'one'):
                yield Look(map=map_name, camera=name, localizer=localizer, drive=number,
                           is_called_wrong=is_called_wrong, is_look=is_look, **fields)


def _alarms(looks: Sequence[Look]) -> list[int]:
    """Return for each drive the number of looks until the camera is called wrong; 0: never."""
    return [any(look.is_called_wrong for look in drive_looks) and 1 + sum(
                look.is_look for look in takewhile(
                    lambda look: not look.is_called_wrong, drive_looks))
            for drive_looks in grouped(looks, ['localizer', 'drive']).values()
            if drive_looks[0].localizer == 'one']


def _called_wrong(looks: Sequence[Look]) -> str:
    alarms = _alarms(looks)
    return f'{sum(map(bool, alarms))} of {len(alarms)}' if alarms else ''


def _after(looks: Sequence[Look]) -> str:
    alarms = [alarm for alarm in _alarms(looks) if alarm]
    return f'{np.median(alarms):.0f}, {max(alarms)}' if alarms else ''


def _before(looks: Sequence[Look]) -> str:
    """Return the number of poses that one localizer accepts before, and how many are wrong."""
    early = [look for look in looks if look.accepted and not look.is_called_wrong
             and look.localizer == 'one']
    return f'{len(early)}, {sum(not look.right for look in early)}'


def run(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, worlds=4, first_seed=3000)
    parser.add_argument('--size', type=positive_int, nargs=2, default=(640, 480),
                        metavar=('W', 'H'), help='size of the images of the query files [px]')
    parser.add_argument('--every', type=positive_int, default=1, metavar='N',
                        help='take each N-th image of a query file')
    parser.add_argument('--drives', type=positive_int, metavar='N',
                        help='only the first N drives or halves of recordings')
    parser.add_argument('--images', type=positive_int, default=60, metavar='N',
                        help='images of a drive (%(default)s)')
    parser.add_argument('--wrong', nargs='+', choices=CAMERAS, default=[*CAMERAS],
                        metavar='WHAT', help=f'{", ".join(CAMERAS)} (all)')
    parser.add_argument('--maps', nargs='+', choices=[*MAPS, REFITTED],
                        default=['given'], metavar='MAP',
                        help=f'{", ".join([*MAPS, REFITTED])} (given)')
    parser.add_argument('--localizers', nargs='+', choices=['new', 'one'], default=['new', 'one'],
                        metavar='WHICH', help='new for each image, one for all images (both)')
    parser.add_argument('--vertical', action='store_true', help='give a vertical, to 1 degree')
    options = parser.parse_args(arguments)
    places = chosen_places(options)[:options.drives]
    if options.cameras > 1 or options.workers > 1:
        raise OptionsError('--cameras and --workers must be 1: one process handles the images of '
                           'one camera in order')
    if options.depth and any(isinstance(place, Simulated) for place in places):
        raise OptionsError('--depth needs --queries or --observations: the simulated drives have '
                           'no depth')
    looks: list[Look] = []
    for number, place in enumerate(tqdm(places, 'drives', disable=None)):
        looks += _looks(number, place, options)
    print(answer_table(looks, ['map', 'camera', 'localizer'],
                       looks=lambda some: sum(look.is_look for look in some),
                       called_wrong=_called_wrong, after_looks_median_most=_after,
                       accepted_wrong_before=_before))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
