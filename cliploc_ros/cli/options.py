# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options that name a recording, say how to read it, and name the keyframes next to a map.

All programs share them.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cliploc_ros.command import finite, not_negative, option, positive, positive_int, within
from cliploc_ros.errors import MapError, ModelError, OptionsError
from cliploc_ros.models.protocols import PROFILE_NAMES

if TYPE_CHECKING:
    from cliploc_ros.core.keyframes.layer import KeyframeLayer
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.offline.recording.keyframe_layer import LayerOptions

#: Options that name a folder, and the key of its layout; '' to detect it.
FOLDERS = {'tum': 'tum', 'rgbd': 'rgbd', 'folder': '', 'colmap': 'colmap', 'nerf': 'nerf'}
SIFT, XFEAT = FEATURES = 'sift', 'xfeat'


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of all sources to a parser."""
    sources = parser.add_argument_group('recordings: one, or several of any kind')
    option(sources, '--bag', 'a rosbag2 recording with images and poses', Path, action='append')
    add_folders(sources, action='append')
    option(sources, '--observations NPZ', 'boxes and poses that were recorded before',
           action='append')
    add_reading_options(parser)
    group = parser.add_argument_group('odometry of --bag')
    odometry = group.add_mutually_exclusive_group()
    option(odometry, '--odometry-topic TOPIC', 'odometry of the body that --pose-topic or '
           '--trajectory describes: Odometry, or another type of pose')
    option(odometry, '--odometry-frame FRAME', 'take odometry from /tf: the coordinate frame of '
           'odometry')
    group = parser.add_argument_group('detector and CLIP, which run once on a recording')
    option(group, '--keyframes METRES DEGREES', 'process an image this far from the last one (0.1 '
           '5; 0 0: every image)', not_negative, (0.1, 5.0))
    add_network_options(group)
    option(group, '--conf', 'least confidence of a detection (%(default)s)', within(0.0, 1.0),
           0.25)
    option(group, '--record-to NPZ', 'the observation file (in the cache folder)')
    option(group, '--workers N', 'local processes (%(default)s)', positive_int, 1)


def add_folders(group: Any, **more: Any) -> None:
    """Add the options that name a folder of images to a group of a parser."""
    option(group, '--tum DIR', 'a TUM RGB-D folder, without its depth', **more)
    option(group, '--rgbd DIR', 'a folder with depth: TUM RGB-D or 7-Scenes', **more)
    option(group, '--folder DIR', 'a folder of any known layout, with its depth: TUM RGB-D, '
           '7-Scenes, Polycam, Record3D, Stray Scanner, ARKitScenes, HoloLens 2, transforms.json, '
           'COLMAP', **more)
    option(group, '--colmap DIR', 'a COLMAP model, or a project with sparse/0 and images/', **more)
    option(group, '--nerf DIR', 'a transforms.json of nerfstudio or Instant-NGP, or its folder',
           **more)


def add_reading_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a recording is read to a parser: poses, images and depth."""
    group = parser.add_argument_group('poses of --bag and TUM RGB-D')
    option(group, '--pose-topic --ground-truth TOPIC', 'PoseStamped, PoseWithCovarianceStamped or '
           'Odometry')
    option(group, '--map-frame FRAME', 'take poses from /tf: the coordinate frame of the map '
           '(map, if the bag has no /ground_truth and no other option names poses)')
    option(group, '--camera-frame FRAME', "the camera's optical coordinate frame in /tf (that of "
           'the images)')
    option(group, '--tf TOPIC', 'topic of the transforms (/tf, or the only one in a namespace; '
           'static transforms: its name with _static)')
    option(group, '--trajectory FILE', 'take poses from a file in TUM format')
    option(group, '--mount --body-from-camera V', 'x y z qx qy qz qw of the camera (z forward) on '
           'the body that the poses of a topic or file describe; 7 numbers for each of '
           '--cameras, in their order', finite, nargs='+')
    option(group, '--max-gap SECONDS', 'interpolate between poses at most this far apart '
           '(%(default)s)', not_negative, 0.5)
    option(group, '--stamp-tolerance SECONDS', 'greatest difference in time between an image '
           'and its pose or depth image (%(default)s)', not_negative, 0.02)
    group = parser.add_argument_group('poses of --folder, --colmap and --nerf')
    option(group, '--images DIR', 'where the images of --colmap or --nerf are, if not beside them')
    option(group, '--scale METRES', 'length of a unit of the poses', positive)
    option(group, '--known-distance IMAGE_A IMAGE_B METRES', 'distance between the cameras of two '
           'images: another way to give the scale')
    option(group, '--level', 'turn z up, by the tilt of the cameras; also for --bag and '
           '--observations')
    option(group, '--axes', 'axes of the cameras that the poses describe, or of inverse poses '
           '(those of the layout)', choices=(
               'opencv', 'opengl', 'opencv-inverse', 'opengl-inverse', 'ros'))
    group = parser.add_argument_group('images and depth of --bag and folders')
    add_topic_options(group)
    option(group, '--depth TOPIC', 'depth registered to the images of --bag')
    option(group, '--intrinsics fr1|fr2|fr3|FILE', 'camera of TUM RGB-D and 7-Scenes, if the '
           'folder does not give it; for --bag, a camera.json instead of camera_info')
    option(group, '--depth-unit METRES', 'length of a unit of a depth image (0.001; 0.0002 for '
           'TUM; 1 for floats)', positive)
    option(group, '--depth-intrinsics FX FY CX CY', 'intrinsics of a depth camera that is not '
           'registered to the images', finite)
    option(group, '--depth-baseline X Y Z', 'its origin, seen from the colour camera [m] (0 0 0)',
           finite)


def add_topic_options(group: Any) -> None:
    """Add the options that name the images of a bag to a parser or a group of it."""
    option(group, '--cameras NAME', 'several cameras of the recording, by the namespaces of their '
           'topics: /NAME/image, /NAME/camera_info and so on', default=[''], nargs='+')
    option(group, '--image TOPIC', "image topic (the recording's only colour image; /image "
           'of --cameras)')
    option(group, '--camera-info TOPIC', 'topic of the camera_info (the one beside the images)')
    option(group, '--rectified', 'the images of the bag are rectified')


def add_network_options(group: Any) -> None:
    """Add the options that name detector and CLIP to a group of a parser."""
    option(group, '--profile', 'detector and CLIP: the same as on the robot, as image embeddings '
           'are specific to a CLIP (%(default)s)', default='balanced', choices=PROFILE_NAMES)
    add_weights_options(group)
    option(group, '--no-clip', 'run no CLIP: boxes and classes only', dest='clip',
           action='store_false')
    option(group, '--scheduler ADDRESS', 'address of a Dask cluster, used instead of local '
           'processes', default='')


def add_weights_options(group: Any) -> None:
    """Add the options that name the weights of detector and CLIP to a group of a parser."""
    option(group, '--model', 'a detector: ONNX file, folder or OWNER/NAME of the hub, or YOLO '
           "weights (the profile's)", default='')
    option(group, '--detector-vocabulary NAMES', "classes that a YOLO-World or YOLOE detects: "
           "'mug, chair', or a map (.yaml) with its classes and labels", default='')
    option(group, '--text-model FILE', 'text tower of that detector (downloaded once)', str, '')
    option(group, '--clip-model', "architecture of open_clip (the profile's)", default='')
    option(group, '--clip-pretrained', 'folder with ONNX files or OWNER/NAME of the hub, or a tag '
           "or file of open_clip (the profile's)", default='')


def folder_of(options: argparse.Namespace) -> tuple[Path, str] | None:
    """Return the folder that the command line names and the key of its layout; '' to detect it."""
    return next(((getattr(options, name), key) for name, key in FOLDERS.items()
                 if getattr(options, name) is not None), None)


def given_options(options: argparse.Namespace, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that differ from their defaults, by option: '--every', '--no-clip'."""
    values = {name: getattr(options, name) for name in defaults}
    return {f'--{"no-" if value is False else ""}{name.replace("_", "-")}': value
            for name, value in values.items() if value != defaults[name]}


def check_folder_options(options: argparse.Namespace) -> None:
    """Refuse options of folders if the source is not a folder; OptionsError names them."""
    given = given_options(options, dict.fromkeys(('images', 'axes', 'scale', 'known_distance')))
    if given and folder_of(options) is None:
        raise OptionsError(f'{", ".join(given)}: for folders of images only')


def add_layer_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the layer to a parser."""
    group = parser.add_argument_group('keyframes next to the map')
    option(group, '--keyframe-layer', 'write NAME.keyframes.npz: local features of the images of '
           '--keyframes, with 3D points from depth or triangulation (default: if the source has '
           'images that suffice for a layer)', action=argparse.BooleanOptionalAction)
    option(group, '--keyframe-points N', 'greatest number of points of a keyframe, 146 bytes '
           'each, or 82 with xfeat (%(default)s)', within(20, 2000), 600)
    option(group, '--keyframe-features', 'kind of features of the keyframes, and later of the '
           'images to localize; xfeat is a network of 2.7 MB, which is downloaded once '
           '(%(default)s)', default=SIFT, choices=FEATURES)
    option(group, '--keyframes-per-cell N', 'of several recordings, most keyframes in a cell of '
           '1 m and 30 degrees: those that localize most others (%(default)s)', positive_int, 40)
    option(group, '--keyframe-images', 'also store small images of the keyframes, for the debug '
           'image: anyone who has the file can see the place')


def layer_options(options: argparse.Namespace) -> 'tuple[LayerOptions | None, str]':
    """Return the options of the layer; None with a note if there can be none, '' if declined.

    OptionsError: the message names the conflicting options. ModelError: the network of the
    features is missing.
    """
    from cliploc_ros.core.keyframes import features
    from cliploc_ros.models.xfeat import load_xfeat
    from cliploc_ros.offline.recording.keyframe_layer import LayerOptions

    problem = (
        '--observations: keyframes need the images of the recording; give --bag or a folder'
        if options.observations is not None else
        '--every: choose frames with --keyframes METRES DEGREES' if options.every > 1 else
        '--refine-mount: build again with the corrected --mount' if options.refine_mount else '')
    if options.keyframe_layer and problem:
        raise OptionsError(f'--keyframe-layer is not for {problem}')
    if problem or options.keyframe_layer is False:
        for is_given, name in ((options.keyframe_images, '--keyframe-images'),
                               (options.keyframe_features == XFEAT, '--keyframe-features')):
            if is_given:
                raise OptionsError(f'{name} is for --keyframe-layer')
        return None, '' if options.keyframe_layer is False else (
            f'{"keyframes are not compared" if options.update else "no keyframes"} with {problem}')
    distance_m, angle_deg = options.keyframes
    return LayerOptions(
        distance_m, angle_deg, options.keyframe_points, options.keyframe_images,
        load_xfeat() if options.keyframe_features == XFEAT else features.SIFT,
        options.workers or 1, options.scheduler), ''


def add_use_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the switch --keyframes to a parser; ``what`` is its help."""
    option(parser, '--keyframes', f'{what} (default: if NAME.keyframes.npz lies next to the map)',
           action=argparse.BooleanOptionalAction)


def read_layer(map_files: Sequence[Path], landmark_map: 'LandmarkMap', wanted: bool | None
               ) -> 'KeyframeLayer | None':
    """Return the layer next to a map, or to each map; None if there is none, or it is not wanted.

    If `wanted` is None, an invalid layer is left out with a note, as in the relocalizer. MapError,
    ModelError: the wanted layer, or the network of its features, is missing or invalid.
    """
    from cliploc_ros.core.keyframes.layer import layer_path, load_layers
    from cliploc_ros.models.xfeat import feature_kinds

    paths = [*map(layer_path, map_files)]
    if wanted is False or (wanted is None and not any(path.exists() for path in paths)):
        return None
    try:
        return load_layers(paths, landmark_map, feature_kinds())
    except (MapError, ModelError) as error:
        if wanted:
            raise
        print(f'without keyframes: {error}', flush=True)
        return None
