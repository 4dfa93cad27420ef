# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo: convert the walk, start the nodes, wake up, and draw the page of pictures."""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.files.storage import make_folder
from cliploc_ros.offline.datasets.bags import BagReader
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.tum import ConversionOptions, TumSequence, convert_tum, read_tum
from cliploc_ros.ros.parameters import RelocalizerParameters
from demo import page
from demo.pictures import draw_top_view, draw_wake_up
from demo.processes import DemoError, node_command, own_ros_domain, running
from demo.review import Judged, Reviewer, judge
from demo.robot import Robot

# The first start compiles the kernels of the search.
_PATIENCE_S = 180.0


@dataclass(frozen=True)
class WakeUpMap:
    """A map to wake up in, instead of the assets' map."""

    file: Path
    #: Returns the id of an object's landmark, '' if the map lacks it
    landmark_of: Callable[[str], str]
    section: str  #: The page's section on the map, as HTML


@dataclass(frozen=True)
class DemoOptions:
    """Options of the demo."""

    assets: Path  #: Folder with sequence/ (a TUM folder) and map.yaml
    #: Parameters that name the networks of detector and relocalizer; the relocalizer needs none
    #: if the method matches classes only. Without them: the networks of the default profile
    detector: Mapping[str, Path]
    encoder: Mapping[str, Path]
    out: Path  #: Folder for the pictures
    wake_ups: int = 10  #: Number of wake-ups
    rate: float = 8.0  #: Speed between wake-ups; 1 is as recorded
    method: str = 'hybrid_auto'  #: Matching and algorithm, joined as in the paper: ``hybrid_auto``
    rviz: bool = False  #: Whether to open RViz if it is installed
    wake_up_map: WakeUpMap | None = None  #: The map to wake up in; None: the assets' map.yaml
    has_rig: bool = False  #: Whether the robot has the cameras of rig/ instead of one
    is_watched: bool = False  #: Whether the localizer is watched and a lost robot is relocalized
    recording: str = ''  #: Name and licence of a real recording; '' for a rendered room

    @property
    def map_file(self) -> Path:
        """Return the file of the map to wake up in."""
        return self.assets / 'map.yaml' if self.wake_up_map is None else self.wake_up_map.file

    @property
    def mounts(self) -> dict[str, list[float]]:
        """Return each camera's pose in the first: x, y, z [m], quaternion x, y, z, w."""
        if not self.has_rig:
            return {'': [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
        file = self.assets / 'rig' / 'mounts.json'
        try:
            return dict(json.loads(file.read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise DemoError(f'{file} cannot be read ({error}): choose another folder '
                            'with --assets') from error

    @property
    def folders(self) -> dict[str, Path]:
        """Return the TUM folder of each camera."""
        return {name: self.assets / 'rig' / name if name else self.assets / 'sequence'
                for name in self.mounts}

    @property
    def parameters(self) -> dict[str, object]:
        """Return the relocalizer's parameters that differ from its defaults."""
        matching, _, algorithm = self.method.partition('_')
        parameters: dict[str, object] = {'map_file': self.map_file,
                                         'matching': matching, 'algorithm': algorithm,
                                         'require_localizer': False,  # the demo has no AMCL
                                         # a search that ends by time is not reproducible
                                         'time_budget_ms': 10_000.0, **self.encoder}
        if self.is_watched:
            parameters |= {'watch': 'amcl_pose', 'watch_period_s': 1.0, 'on_lost': 'relocalize',
                           'require_localizer': True}
        if self.has_rig:
            # the pose of the first camera
            parameters |= {**self.of_rig, 'base_frame': 'camera_optical_frame',
                           'base_from_camera': list(chain(*self.mounts.values()))}
        return parameters

    @property
    def of_rig(self) -> dict[str, object]:
        """Return the parameters of both nodes for a rig; none for a single camera.

        Fast DDS with its default settings does not deliver the raw images of four cameras at once.
        """
        return {'cameras': list(self.mounts), 'image_transport': 'compressed'} \
            if self.has_rig else {}

    @property
    def values(self) -> RelocalizerParameters:
        """Return all of the relocalizer's parameters."""
        given: dict[str, Any] = {name: str(value) if isinstance(value, Path) else value
                                 for name, value in self.parameters.items()}
        return RelocalizerParameters(**given)


def run_demo(options: DemoOptions) -> list[Judged]:
    """Let the robot walk and wake up, and draw the results; return the wake-ups.

    CliplocError: assets are missing or invalid, or the nodes do not run.
    """
    start = time.monotonic()
    prepare(options)
    landmark_map = LandmarkMap.from_file(options.map_file)
    sequences = {name: read_tum(folder) for name, folder in options.folders.items()}
    sequence = next(iter(sequences.values()))
    with TemporaryDirectory(prefix='cliploc_demo_') as folder, ExitStack() as stack:
        for name, walk in sequences.items():
            convert_tum(walk, find_camera(None, walk.folder)[0], Path(folder) / f'walk_{name}',
                        ConversionOptions(
                            world_frame=landmark_map.frame_id, prefix=name,
                            image_format='compressed' if options.has_rig else 'raw'))
        print(f'converted a walk of {sum(map(len, sequences.values()))} images into a recording',
              flush=True)
        domain = stack.enter_context(own_ros_domain())
        rviz = None
        if options.rviz and shutil.which('rviz2'):
            config = Path(__file__).with_name('demo.rviz')
            rviz = stack.enter_context(running(
                ['rviz2', '-d', config, '-f', landmark_map.frame_id], options.out / 'rviz2.log'))
        elif options.rviz:
            print('RViz (rviz2) is not installed or not sourced: continuing without it')
        judged = _walk(options, Path(folder), sequence, domain)
        print(page.summary(judged), flush=True)
        index = _draw(options, landmark_map, sequences, judged)
        print(f'pictures: {index.resolve()}; total time {time.monotonic() - start:.0f} s',
              flush=True)
        if rviz is not None:
            print('close RViz to end the demo')
            rviz.wait()
    return judged


def prepare(options: DemoOptions) -> None:
    """Check options and assets, and make the folder for the pictures, before anything starts.

    CliplocError: the method is unknown, assets are missing, or the folder cannot be written.
    """
    options.values.check()
    # Make the folder for the pictures, and remove those of an earlier run.
    make_folder(options.out)
    for picture in options.out.glob(page.PICTURES):
        picture.unlink()
    needed = [options.assets / ('rig' if options.has_rig else 'sequence'),
              options.map_file, *options.detector.values(), *options.encoder.values()]
    for path in needed:
        if not path.exists():
            raise DemoError(f'{path} is missing: choose another folder with --assets')


def _walk(options: DemoOptions, folder: Path, sequence: TumSequence, domain: int
          ) -> list[Judged]:
    """Let the robot wake up along the recordings; print each answer as it arrives."""
    chosen = np.linspace(0, len(sequence) - 1, min(options.wake_ups, len(sequence)))
    wake_up_at = {sequence.stamps_ns[round(index)] for index in chosen}
    judged: list[Judged] = []
    with nodes(options, domain) as check, ExitStack() as stack:
        readers = {name: stack.enter_context(BagReader(folder / f'walk_{name}'))
                   for name in options.mounts}
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        robot = Robot(readers, check)
        try:
            robot.connect()
            print('\n' + page.console_header(), flush=True)
            for wake_up in robot.walk(wake_up_at, options.rate):
                judged.append(judge(wake_up, len(judged) + 1, sequence))
                print(page.console_row(judged[-1]), flush=True)
        finally:
            robot.destroy_node()
            rclpy.try_shutdown()
    return judged


@contextmanager
def nodes(options: DemoOptions, domain: int) -> Iterator[Callable[[], None]]:
    """Run detector and relocalizer; yield a function that raises an error if one has ended."""
    start = time.monotonic()
    print(f'starting detector and relocalizer ({options.method}); to see their topics: export '
          f'ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST', flush=True)
    with (running(node_command('detector', {**options.detector, **options.of_rig}),
                  options.out / 'detector.log') as detector,
          running(node_command('relocalizer', options.parameters),
                  options.out / 'relocalizer.log') as relocalizer):
        detector.wait_for_output('ready after', _PATIENCE_S)
        relocalizer.wait_for_output('landmarks in frame', _PATIENCE_S)
        print(f'both are ready after {time.monotonic() - start:.1f} s', flush=True)

        def check() -> None:
            detector.check()
            relocalizer.check()

        yield check


def _draw(options: DemoOptions, landmark_map: LandmarkMap, sequences: dict[str, TumSequence],
          judged: list[Judged]) -> Path:
    """Draw all pictures and the page that shows them; return the page."""
    own, sequence = options.wake_up_map, next(iter(sequences.values()))
    reviewer = Reviewer(options.values, landmark_map, sequences, options.mounts,
                        str if own is None else own.landmark_of)
    reviews = []
    for wake_up in judged:
        reviews.append(reviewer.review(wake_up))
        draw_wake_up(reviews[-1], landmark_map, options.out / page.picture_name(wake_up))
    # The camera's path while it took images (t, 3) [m].
    truth = sequence.trajectory
    first, last = sequence.stamps_ns[0], sequence.stamps_ns[-1]
    walked = truth.positions_xyz[(truth.stamps_ns >= first) & (truth.stamps_ns <= last)]
    draw_top_view(judged, landmark_map, walked, options.out / page.TOP_VIEW)
    section = '' if own is None else own.section
    if options.has_rig:
        alone = sum(review.accepted_alone for review in reviews)
        print(f'{len(sequences)} cameras; with the first camera alone, {alone} of {len(reviews)} '
              'would be accepted', flush=True)
        section += page.rig_section(list(sequences), alone, len(reviews))
    return page.write_page(options.out, reviews, options.method, section, options.recording)
