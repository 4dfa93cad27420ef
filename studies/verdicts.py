# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts on maps against what a robot gets: ``python -m studies.verdicts MODEL OUT FOLDER...``.

Every second image of each folder (``DIR[@METRES]``, see studies.rooms) is mapped, well and spoiled
in several ways. The map is checked, and 24 of the other images are localized in it by classes:
accepted and false accepts by objects and keyframes, by objects alone, and by keyframes alone.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.relocalization import count_verdicts, try_view
from cliploc_ros.offline.mapping.make_map import Labeller, MadeMap, make_map
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions
from studies.rooms.rooms import (
    Image,
    Room,
    RoomOptions,
    frames_of_raws,
    known_of,
    read_room,
    without_boxes,
)

_QUICK = CheckOptions(max_positions=25, headings=6, frames=30)
_ASKED = 24
# Every n-th image is mapped, with a focal length that is wrong by a factor.
_CASES = {'good': (2, 1.0), 'half moved': (2, 1.0), 'keyframes off': (2, 1.0),
          'one landmark': (2, 1.0), 'no keyframes': (2, 1.0), 'few images': (14, 1.0),
          'wrong focal length': (2, 1.25)}


def spoiled(made: MadeMap, case: str) -> MadeMap:
    """Return a map with every second landmark, or all keyframes, off by 1.5 m; or without some."""
    landmarks, layer = made.landmark_map, None if case == 'no keyframes' else made.layer
    offset, centers = np.zeros((4, 4)), landmarks.centers.copy()
    centers[::2, 0] += 1.5 * (case == 'half moved')
    offset[0, 3] = 1.5 * (case == 'keyframes off')
    landmarks = replace(landmarks, centers=centers)
    return replace(
        made, landmark_map=landmarks.select(range(1)) if case == 'one landmark' else landmarks,
        layer=layer and replace(layer, map_from_camera=layer.map_from_camera + offset))


def main(model: str, out: str, *folders: str) -> None:
    """Print a row for each map."""
    for room, (case, (step, factor)) in ((read_room(folder, RoomOptions(model, Path(out))), case)
                                         for folder in folders for case in _CASES.items()):
        mapped, asked = np.arange(0, len(room), step), np.arange(1, len(room), 2)

        def longer(camera: Camera, factor: float = factor) -> Camera:
            return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)

        def color(row: int, room: Room = room, longer: Callable[[Camera], Camera] = longer
                  ) -> tuple[Image, Camera]:
            image, camera = room.raws[row].color()
            return image, longer(camera)

        def image_of(row: int, room: Room = room) -> Image:
            return room.raws[row].color()[0]

        raws = tuple(replace(raw, color=partial(color, row)) for row, raw in enumerate(room.raws))
        seen = replace(room.detections, cameras=tuple(map(longer, room.detections.cameras))
                       ).select_frames(mapped)
        frames = frames_of_raws(room.frames.source, raws).select(mapped.tolist())
        try:
            made = spoiled(make_map(seen, Labeller({}), MappingOptions(estimate_pose_errors=True),
                                    frames, LayerOptions()), case)
        except CliplocError as error:
            print(f'{room.name}, {case}: no map: {error}', flush=True)
            continue
        report = check_map(made.landmark_map, seen, _QUICK, layer=made.layer,
                           image_of=partial(lambda rows, frame: image_of(rows[frame]), mapped))
        print(f'{room.name}, {case}: {report.verdict}; {report.localized[0]}', flush=True)
        for way in ('both', 'objects', 'keyframes'):
            relocalizer = Relocalizer(made.landmark_map, RelocalizerOptions(matching='class'))
            localizer = Localizer(relocalizer, None if way == 'objects' or made.layer is None else
                                  KeyframeLocalizer(made.layer))
            trials = []
            for row in asked[np.linspace(0, len(asked) - 1, _ASKED).astype(int)]:
                query = room.queries[row]
                plain = known_of(query.observation, '-')
                trials.append(try_view(localizer, replace(
                    query, image=partial(image_of, row),
                    observation=without_boxes(plain) if way == 'keyframes' else plain), 0, _QUICK))
            print(f'  {way}: {count_verdicts(trials)}', flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
