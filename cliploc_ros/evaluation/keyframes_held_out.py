# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes on data that chose nothing: ``python -m cliploc_ros.evaluation.keyframes_held_out``.

The constants of keyframes were chosen on a kitchen. Here are rendered rooms (made by
``python -m demo_world.make_keyframe_rooms``) and the 17 images of TUM fr3. The points of both are
triangulated, without depth. The queries: other viewpoints, other light, the other side of the
room, and those that must not be accepted: images of other rooms, a second room that looks the same
and lacks three objects, posters of another place. By classes alone, without CLIP.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.folders import tum_frames
from cliploc_ros.datasets.frames import Frame, Frames
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.keyframe_study.asking import Place, Row, query_of, table
from cliploc_ros.evaluation.keyframe_study.changes import (
    elsewhere,
    put_poster,
    twin_layer,
    twin_map,
)
from cliploc_ros.evaluation.keyframe_study.reliability import false_accepts, reliability
from cliploc_ros.evaluation.output import make_folder, write_text
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import YoloOptions
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer

_ROOM_MODEL = Path(__file__).parents[1] / 'demo' / 'assets' / 'yolo.pt'

_EVERY_IMAGE = LayerOptions(0.0, 0.0)
_POSTER_SHARES = (0.3, 0.6)
_TWIN_LACKS = 3


@dataclass(frozen=True)
class Site:
    """A mapped place: its detector, the mapped images, and queries by name."""

    name: str
    place: Place
    detector: ObjectDetector
    mapped: list[Frame]
    queries: dict[str, list[Frame]]

    def ask(self, case: str, frames: Sequence[Frame], is_here: bool = True,
            place: Place | None = None) -> list[Row]:
        """Localize images; of another room if not here."""
        asked = place or self.place
        return [asked.ask(f'{self.name}: {case}', number,
                          query_of(frame, self.detector, is_here))
                for number, frame in enumerate(tqdm(frames, case, disable=None))]


def read_walk(folder: Path) -> Frames:
    """Return the images of a TUM folder."""
    return tum_frames(read_tum(folder), find_camera(None, folder)[0])


def make_site(name: str, frames: Frames, landmark_map: LandmarkMap, detector: ObjectDetector,
              queries: dict[str, list[Frame]]) -> Site:
    """Return a place whose layer is made of images."""
    layer = build_layer(frames, landmark_map, _EVERY_IMAGE)
    print(f'{name}: {len(landmark_map)} landmarks, {len(layer)} keyframes of {frames.count} '
          f'images, {len(layer.points)} points', flush=True)
    return Site(name, Place(landmark_map, KeyframeLocalizer(layer)), detector,
                list(frames.read()), queries)


def sites(rooms: Sequence[Path], room_model: str, office: Path | None, office_model: str
          ) -> Iterator[Site]:
    """Yield the mapped places of rooms and of an office."""
    for folder in rooms:
        detector = YoloDetector(YoloOptions(room_model, conf=0.25))
        landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
        for mapped, asked in (('mapping', ('viewpoints', 'other_light')),
                              ('one_side', ('other_side',))):
            yield make_site(f'{folder.name} {mapped}', read_walk(folder / mapped), landmark_map,
                            detector, {name: list(read_walk(folder / name).read())
                                       for name in asked})
    if office is not None:
        detector = YoloDetector(YoloOptions(office_model, conf=0.25))
        landmark_map = LandmarkMap.from_file(office / 'map.yaml')
        frames = read_walk(office)
        even, odd = range(0, frames.count, 2), range(1, frames.count, 2)
        yield make_site('fr3 even', frames.select(even), landmark_map, detector,
                        {'odd': list(frames.select(odd).read())})
        yield make_site('fr3 odd', frames.select(odd), landmark_map, detector,
                        {'even': list(frames.select(even).read())})


def right_cases(site: Site) -> Iterator[list[Row]]:
    """Yield the results of images of the place."""
    for name, frames in site.queries.items():
        yield site.ask(name, frames)


def wrong_cases(site: Site, others: Sequence[Site], every: int, seed: int
                ) -> Iterator[list[Row]]:
    """Yield the results of what must not be accepted away from the truth."""
    own = [frame for frames in site.queries.values() for frame in frames][::every]
    place = site.place
    twins = Place(twin_map(place.landmark_map, _TWIN_LACKS, np.random.default_rng(seed)),
                  KeyframeLocalizer(twin_layer(place.keyframes.layer)))
    yield site.ask('two rooms that differ in 3 objects', own, place=twins)
    for share in _POSTER_SHARES:
        rng = np.random.default_rng(seed)
        posters = [(frame, elsewhere(frame, site.mapped, rng)) for frame in own]
        yield site.ask(f'poster on {share:.0%}', [
            replace(frame, image_rgb=put_poster(frame.image_rgb, other.image_rgb, share))
            for frame, other in posters])
    strange = [frame for other in others for frames in other.queries.values()
               for frame in islice(frames, 0, None, every)]
    yield site.ask('images of other rooms', strange, is_here=False)


def run(arguments: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog='keyframes_held_out', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rooms', type=Path, nargs='*', default=[], metavar='DIR')
    parser.add_argument('--room-model', default=str(_ROOM_MODEL),
                        help='weights of YOLO for the rooms (%(default)s)')
    parser.add_argument('--office', type=Path, metavar='DIR', help='the folder of TUM fr3')
    parser.add_argument('--office-model', default='', help='weights of YOLO for the office')
    parser.add_argument('--out', type=Path, default=Path('keyframes_held_out'), metavar='DIR')
    parser.add_argument('--every', type=positive_int, default=1, metavar='N',
                        help='of queries that must not be accepted, take each N-th (%(default)s)')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    if not options.rooms and options.office is None:
        raise OptionsError('nothing to measure: give --rooms or --office')
    cv2.setNumThreads(1)
    make_folder(options.out)
    places = list(sites(options.rooms, options.room_model, options.office, options.office_model))
    rows: list[Row] = []
    for site in places:
        others = [one for one in places
                  if one.place.landmark_map is not site.place.landmark_map]
        for cases in (right_cases(site), wrong_cases(site, others, options.every, options.seed)):
            for found in cases:
                rows += found
                print('\n'.join(table(found)[1:]), flush=True)
                write_text(options.out / 'results.json',
                           json.dumps([row.as_dict() for row in rows], indent=1))
    print('\n'.join([*table(rows), '', *false_accepts(rows), '', *reliability(rows)]))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
