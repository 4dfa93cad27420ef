# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options that name a recording and say how to read it: one table for all programs."""

import argparse
from pathlib import Path
from typing import Any

from cliploc_ros.command import finite, not_negative, positive, positive_int, within
from cliploc_ros.errors import OptionsError
from cliploc_ros.models.devices import INFERENCES
from cliploc_ros.models.profiles import PROFILE_NAMES

# Of folders only.
_PLACING = ('images', 'axes', 'scale', 'known_distance')


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of all sources to a parser."""
    sources = parser.add_mutually_exclusive_group(required=True)
    sources.add_argument('--bag', type=Path, help='a rosbag2 recording with images and poses')
    add_folders(sources)
    sources.add_argument('--observations', type=Path, metavar='NPZ',
                         help='boxes and poses that were recorded before')
    add_reading_options(parser)
    group = parser.add_argument_group('odometry of --bag')
    odometry = group.add_mutually_exclusive_group()
    odometry.add_argument('--odometry-topic', metavar='TOPIC',
                          help='of what --pose-topic or --trajectory is of: Odometry, or another '
                          'type of pose')
    odometry.add_argument('--odometry-frame', metavar='FRAME',
                          help='take odometry from /tf: its coordinate frame')
    group = parser.add_argument_group('detector and CLIP, which run once on a recording')
    group.add_argument('--keyframes', type=not_negative, nargs=2, default=(0.1, 5.0),
                       metavar=('METRES', 'DEGREES'),
                       help='look at an image this far from the last one (0.1 5; 0 0: at all)')
    add_network_options(group)
    group.add_argument('--conf', type=within(0.0, 1.0), default=0.25,
                       help='least confidence of a detection (%(default)s)')
    group.add_argument('--record-to', type=Path, metavar='NPZ',
                       help='the observation file (next to the recording)')
    group.add_argument('--workers', type=positive_int, default=1, metavar='N',
                       help='local processes (%(default)s)')


def add_folders(group: Any) -> None:
    """Add the options that name a folder of images to a group of a parser."""
    group.add_argument('--tum', type=Path, metavar='DIR', help='a TUM RGB-D folder, no depth')
    group.add_argument('--rgbd', type=Path, metavar='DIR',
                       help='a folder with depth: TUM RGB-D or 7-Scenes')
    group.add_argument('--folder', type=Path, metavar='DIR',
                       help='a folder of any known layout, with its depth: TUM RGB-D, 7-Scenes, '
                       'Polycam, Record3D, Stray Scanner, ARKitScenes, HoloLens 2, '
                       'transforms.json, COLMAP')
    group.add_argument('--colmap', type=Path, metavar='DIR',
                       help='a COLMAP model, or a project with sparse/0 and images/')
    group.add_argument('--nerf', type=Path, metavar='DIR',
                       help='a transforms.json of nerfstudio or Instant-NGP, or its folder')


def add_reading_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a recording is read to a parser: poses, images and depth."""
    group = parser.add_argument_group('poses of --bag and TUM RGB-D')
    group.add_argument('--pose-topic', '--ground-truth', metavar='TOPIC',
                       help='PoseStamped, PoseWithCovarianceStamped or Odometry')
    group.add_argument('--map-frame', metavar='FRAME',
                       help='take poses from /tf: the coordinate frame of the map (map, where '
                       'the bag has no /ground_truth and nothing else is named)')
    group.add_argument('--camera-frame', metavar='FRAME',
                       help="the camera's optical coordinate frame in /tf (that of the images)")
    group.add_argument('--trajectory', type=Path, metavar='FILE',
                       help='take poses from a file in TUM format')
    group.add_argument('--mount', '--body-from-camera', type=finite, nargs='+', metavar='V',
                       help='x y z qx qy qz qw of the camera (z forward) on what the poses of a '
                       'topic or file are of; 7 numbers for each of --cameras, in their order')
    group.add_argument('--max-gap', type=not_negative, default=0.5, metavar='SECONDS',
                       help='interpolate between poses at most so far apart (%(default)s)')
    group = parser.add_argument_group('poses of --folder, --colmap and --nerf')
    group.add_argument('--images', type=Path, metavar='DIR',
                       help='where the images of --colmap or --nerf are, if not beside them')
    group.add_argument('--scale', type=positive, metavar='METRES', help='of a unit of the poses')
    group.add_argument('--known-distance', nargs=3, metavar=('IMAGE_A', 'IMAGE_B', 'METRES'),
                       help='between the cameras of two images: another way to say the scale')
    group.add_argument('--level', action='store_true',
                       help='turn z up, by the tilt of the cameras; of --bag and --observations, '
                       'too')
    group.add_argument('--axes', choices=('opencv', 'opengl', 'opencv-inverse', 'opengl-inverse'),
                       help='what the poses are: of cameras with these axes, or inverse '
                       "(the layout's own)")
    group = parser.add_argument_group('images and depth of --bag and folders')
    add_topic_options(group)
    group.add_argument('--depth', metavar='TOPIC', help='depth registered to the images of --bag')
    group.add_argument('--intrinsics', metavar='fr1|fr2|fr3|FILE',
                       help='camera of TUM RGB-D and 7-Scenes, where the folder does not say it')
    group.add_argument('--depth-unit', type=positive, metavar='METRES',
                       help='one count of a depth image (0.001; 0.0002 for TUM; 1 for floats)')
    group.add_argument('--depth-intrinsics', type=finite, nargs=4,
                       metavar=('FX', 'FY', 'CX', 'CY'),
                       help='of a depth camera that is not registered to the images')
    group.add_argument('--depth-baseline', type=finite, nargs=3, metavar=('X', 'Y', 'Z'),
                       help='its origin, seen from the colour camera [m] (0 0 0)')


def add_topic_options(group: Any) -> None:
    """Add the options that name the images of a bag to a parser or a group of it."""
    group.add_argument('--cameras', nargs='+', default=[''], metavar='NAME',
                       help='several cameras of the recording, by the namespaces of their topics: '
                       '/NAME/image, /NAME/camera_info and so on')
    group.add_argument('--image', metavar='TOPIC',
                       help="(the recording's only colour image; /image of --cameras)")
    group.add_argument('--camera-info', metavar='TOPIC', help='(the one beside the image)')
    group.add_argument('--rectified', action='store_true', help='the bag has rectified images')


def add_network_options(group: Any) -> None:
    """Add the options that name detector and CLIP to a group of a parser."""
    group.add_argument('--profile', choices=PROFILE_NAMES, default='auto',
                       help='detector and CLIP: that of the robot, as image embeddings are of one '
                       'CLIP (%(default)s: accurate on a GPU, balanced on a CPU)')
    group.add_argument('--model', default='', help=
                       "YOLO weights, or a detector of transformers: folder or OWNER/NAME "
                       "(the profile's)")
    group.add_argument('--detector-vocabulary', default='', metavar='NAMES',
                       help="what a YOLO-World or YOLOE looks for: 'mug, chair', or a map (.yaml) "
                       'with its classes and labels')
    group.add_argument('--text-model', default='', metavar='FILE',
                       help='text tower of that detector (downloaded once)')
    group.add_argument('--clip-model', default='', help="(the profile's)")
    group.add_argument('--clip-pretrained', default='', help="tag or file (the profile's)")
    group.add_argument('--device', default='auto', help='(%(default)s)')
    group.add_argument('--inference', choices=INFERENCES, default='auto',
                       help='(%(default)s: OpenVINO on a CPU where it is installed)')
    group.add_argument('--no-clip', dest='clip', action='store_false',
                       help='run no CLIP: boxes and classes only')
    group.add_argument('--scheduler', default='', metavar='ADDRESS',
                       help='of a Dask cluster, instead of local processes')


def folder_of(options: argparse.Namespace) -> tuple[Path, str] | None:
    """Return the folder that the command line names and the key of its layout; '' to find it."""
    named = {'tum': 'tum', 'rgbd': 'rgbd', 'folder': '', 'colmap': 'colmap', 'nerf': 'nerf'}
    return next(((getattr(options, name), key) for name, key in named.items()
                 if getattr(options, name) is not None), None)


def check_folder_options(options: argparse.Namespace) -> None:
    """Refuse options of folders with another source; OptionsError names them."""
    given = [f'--{name.replace("_", "-")}' for name in _PLACING
             if getattr(options, name) not in (None, False)]
    if given and folder_of(options) is None:
        raise OptionsError(f'{", ".join(given)}: for folders of images only')
