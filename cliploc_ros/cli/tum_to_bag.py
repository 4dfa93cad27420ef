# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``tum_to_bag``: convert a TUM RGB-D folder into a rosbag2 recording."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.command import option, positive_int, program, run_main
from cliploc_ros.offline.datasets.bags import STORAGES

EPILOG = """\
topics (with --prefix camera: /camera/image and so on):
  /image or /image/compressed   sensor_msgs/Image or CompressedImage
  /camera_info                  sensor_msgs/CameraInfo
  /ground_truth                 geometry_msgs/PoseStamped, the camera in the world frame
  /detections                   vision_msgs/Detection2DArray, with --detections
  /imu                          sensor_msgs/Imu, where the folder has accelerometer.txt

examples:
  tum_to_bag rgbd_dataset_freiburg3_long_office_household office
  tum_to_bag desk desk_bag --intrinsics fr1 --every 10 --compressed --storage mcap
"""


def main(args: Sequence[str] | None = None) -> int:
    """Convert a sequence; return the exit code."""
    return run_main(make_parser(), convert, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = program('tum_to_bag', EPILOG, 'Convert a TUM RGB-D folder (rgb.txt, rgb/, '
                     'groundtruth.txt), 7-Scenes or another folder of build_map --folder into a '
                     'rosbag2 recording with the topics of the nodes, without depth. Needs no '
                     'sourced ROS.')
    option(parser, 'folder', 'the folder', Path)
    option(parser, 'output', 'folder of the recording; must not exist', Path)
    option(parser, '--every N', 'take only every N-th image (default: 1)', positive_int, 1)
    option(parser, '--detections FILE', 'also write these recorded detections (JSON)')
    option(parser, '--intrinsics fr1|fr2|fr3|FILE', "the dataset's camera, or a camera.json "
           "(default: the folder's camera.json, otherwise the camera in the folder's name)")
    option(parser, '--storage', 'default: %(default)s', default='sqlite3', choices=list(STORAGES))
    images = parser.add_mutually_exclusive_group()
    option(images, '--raw', 'write decoded images (the default)', default='raw',
           dest='image_format', action='store_const', const='raw')
    option(images, '--compressed', 'write the bytes of the image files as compressed images',
           dest='image_format', action='store_const', const='compressed')
    option(parser, '--prefix', 'namespace of all topics', default='')
    option(parser, '--camera-frame', 'default: %(default)s', default='camera_optical_frame')
    option(parser, '--world-frame', 'default: %(default)s', default='world')
    return parser


def convert(options: argparse.Namespace) -> int:
    """Convert a folder; print what was written, and how many images have no pose or detections."""
    # Imported late, so that --help is fast.
    from cliploc_ros.offline.datasets import tum
    from cliploc_ros.offline.datasets.folders import read_sequence

    begin = time.monotonic()
    sequence, camera, origin = read_sequence(options.folder, options.intrinsics)
    sequence = sequence.every(options.every)
    detections = None
    if options.detections is not None:
        detections = tum.read_recorded_detections(
            options.detections, (camera.width, camera.height))
    print(f'{len(sequence)} images, intrinsics: {origin}', flush=True)
    written = tum.convert_tum(
        sequence, camera, options.output,
        tum.ConversionOptions(
            options.storage, options.image_format, prefix=options.prefix,
            camera_frame=options.camera_frame, world_frame=options.world_frame),
        detections)
    print(f'wrote {options.output}: {len(sequence)} images, {written["poses"]} ground-truth '
          f'poses, {written["detections"]} detection messages, {written["accelerations"]} '
          f'accelerations in {time.monotonic() - begin:.1f} s')
    if len(sequence.trajectory) == 0:
        print('the folder has no ground truth')
    elif missing := len(sequence) - written['poses']:
        print(f'{missing} images have no ground truth within 20 ms and so no pose')
    if options.detections is not None and (missing := len(sequence) - written['detections']):
        print(f'{missing} images have no recorded detections and so no detection message')
    return 0


if __name__ == '__main__':
    sys.exit(main())
