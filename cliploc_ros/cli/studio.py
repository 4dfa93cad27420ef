# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``studio``: create, correct and test a map in the browser."""

import argparse
import itertools
import sys
import threading
import webbrowser
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cliploc_ros.cli.options import add_topic_options, read_layer
from cliploc_ros.command import needs_ros, option, program, run_main, within

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.studio import Studio

_LOOPBACK = '127.0.0.1'
EPILOG = """\
examples:
  studio office.yaml         a map of build_map, with its recording
  studio office.yaml --observations office.npz --images office_bag
  studio office.yaml --images tum_folder_with_ground_truth
  studio                     an empty map, to be saved as map.yaml
  studio office.yaml --ros   with the answers of the running relocalizer

Edits are saved beside the map as they are made: after a crash, the studio restores them.
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the studio; return the exit code."""
    return run_main(make_parser(), serve, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = program('studio', EPILOG, 'Create and correct a map in the browser. Needs no sourced '
                     'ROS, except for --ros.')
    option(parser, 'map MAP', 'a map file; a new one starts empty (map.yaml, or the first unused '
           'name of map-2.yaml, map-3.yaml, ...)', nargs='?')
    option(parser, '--observations NPZ', 'boxes and poses of a recording of the place')
    option(parser, '--images BAG|DIR', 'a rosbag2 recording, or a folder as for build_map '
           '--folder, with the images of the views')
    add_topic_options(parser)
    option(parser, '--occupancy-grid FILE', 'show the walls: the YAML file of nav2_map_server, in '
           "the map's coordinate frame")
    option(parser, '--port N', 'the first port to try; if it is in use, the next free one '
           '(%(default)s)', within(0, 65535), 8080)
    option(parser, '--host ADDRESS', 'listen at this address (%(default)s: this machine only)',
           default=_LOOPBACK)
    option(parser, '--ros', "show the running relocalizer's last answer in the map, and let it "
           'relocalize and reload the map')
    option(parser, '--relocalizer NAME', 'its name, with its namespace (%(default)s)',
           default='/relocalizer')
    option(parser, '--no-browser', 'only print the URL')
    return parser


def serve(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; return the exit code."""
    # Imported late, so that --help is fast.
    from cliploc_ros.offline.mapping.tilt import tilt_note
    from cliploc_ros.offline.studio.page import serve_studio
    from cliploc_ros.offline.studio.web import private_page

    studio = open_studio(options)
    try:
        relocalizer: AbstractContextManager[Any] = nullcontext()
        if options.ros:
            with needs_ros('--ros'):
                from cliploc_ros.offline.studio.live import follow_relocalizer
            relocalizer = follow_relocalizer(options.relocalizer, options.ros_args)
        with (relocalizer as live,
              serve_studio(studio, options.host, options.port, live) as (url, _)):
            print(f'{studio.document.path}: {len(studio.document.landmarks)} landmarks, '
                  f'{studio.views} views')
            tilt = '' if studio.recording is None else tilt_note(
                studio.recording.detections.map_from_camera,
                studio.recording.images is None or not studio.recording.images.of_folder)
            for note in filter(None, (*studio.document.notes, tilt)):
                print(f'note: {note}')
            print(f'studio: {url}', flush=True)
            with nullcontext() if options.no_browser else private_page(
                    url, studio.document.path.absolute()) as page:
                if page is not None:
                    webbrowser.open(page.as_uri())
                threading.Event().wait()
    finally:
        studio.document.close()
    return 0


def open_studio(options: argparse.Namespace) -> 'Studio':
    """Return the studio that the command line asks for."""
    from cliploc_ros.cli.sources import recorded
    from cliploc_ros.offline.datasets.folders import find_layout
    from cliploc_ros.offline.datasets.images import views_of_folder
    from cliploc_ros.offline.datasets.map_recording import load_recording
    from cliploc_ros.offline.studio.document import Document
    from cliploc_ros.offline.studio.recording import Recording
    from cliploc_ros.offline.studio.room import read_walls
    from cliploc_ros.offline.studio.studio import Studio

    is_folder = options.images is not None and find_layout(options.images) is not None
    built_from = None if options.map is None else load_recording(options.map)
    if is_folder and built_from is not None and built_from.source is not None and not (
            built_from.source.samefile(options.images)):
        built_from = None  # the folder has different poses
    detections, images = recorded(options, built_from)
    if detections is None and options.images is not None:
        detections = views_of_folder(options.images)
    recording = None if detections is None else Recording(
        detections, images, built_from is not None and built_from.scale != 1.0)
    # a new map gets the first unused name
    names = itertools.chain(['map.yaml'], (f'map-{number}.yaml' for number in itertools.count(2)))
    document = Document(options.map or next(
        path for path in map(Path, names) if not path.exists()))
    layer = read_layer([document.path], document.to_map(), None)
    walls = None if options.occupancy_grid is None else read_walls(options.occupancy_grid)
    return Studio(document, recording, layer, walls)


if __name__ == '__main__':
    sys.exit(main())
