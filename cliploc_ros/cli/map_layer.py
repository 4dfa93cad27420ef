# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer of keyframes next to a map: options to write it and to read it."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.command import option, positive_int
from cliploc_ros.errors import MapError, ModelError, OptionsError

if TYPE_CHECKING:
    from cliploc_ros.core.keyframes.layer import KeyframeLayer
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.offline.recording.keyframe_layer import LayerOptions

_DEFAULT_POINTS = 600
SIFT, XFEAT = FEATURES = 'sift', 'xfeat'


def add_layer_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the layer to a parser."""
    group = parser.add_argument_group('keyframes next to the map')
    option(group, '--keyframe-layer', 'write NAME.keyframes.npz: local features of the images of '
           '--keyframes, with 3D points from depth or triangulation (default: if the source has '
           'images that suffice for a layer)', action=argparse.BooleanOptionalAction)
    option(group, '--keyframe-points N', 'greatest number of points of a keyframe, 146 bytes '
           'each, or 82 with xfeat (%(default)s)', positive_int, _DEFAULT_POINTS)
    option(group, '--keyframe-features', 'kind of features of the keyframes, and later of the '
           'images to localize; xfeat is a network of 2.7 MB, which is downloaded once '
           '(%(default)s)', default=SIFT, choices=FEATURES)
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

    problem = next((
        f'--{name}: keyframes need the images of the recording that the map is built from; give '
        '--bag or a folder' for name in ('observations', 'update')
        if getattr(options, name) is not None),
        '--every: choose frames with --keyframes METRES DEGREES' if options.every > 1 else
        '--refine-mount: build again with the corrected --mount' if options.refine_mount else '')
    if options.keyframe_layer and problem:
        raise OptionsError(f'--keyframe-layer is not for {problem}')
    if problem or options.keyframe_layer is False:
        for is_given, name in ((options.keyframe_images, '--keyframe-images'),
                               (options.keyframe_features == XFEAT, '--keyframe-features')):
            if is_given:
                raise OptionsError(f'{name} is for --keyframe-layer')
        return None, '' if options.keyframe_layer is False else f'no keyframes with {problem}'
    distance_m, angle_deg = options.keyframes
    return LayerOptions(
        distance_m, angle_deg, options.keyframe_points, options.keyframe_images,
        load_xfeat() if options.keyframe_features == XFEAT else features.SIFT), ''


def add_use_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the switch --keyframes to a parser; ``what`` is its help."""
    option(parser, '--keyframes', f'{what} (default: if NAME.keyframes.npz lies next to the map)',
           action=argparse.BooleanOptionalAction)


def read_layer(map_file: Path, landmark_map: 'LandmarkMap', wanted: bool | None
               ) -> 'KeyframeLayer | None':
    """Return the layer next to a map; None if there is none, or it is not wanted.

    If `wanted` is None, an invalid layer is left out with a note, as in the relocalizer. MapError,
    ModelError: the wanted layer, or the network of its features, is missing or invalid.
    """
    from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
    from cliploc_ros.models.xfeat import feature_kinds

    path = layer_path(map_file)
    if wanted is False or (wanted is None and not path.exists()):
        return None
    try:
        return load_layer_of_map(path, landmark_map, feature_kinds())
    except (MapError, ModelError) as error:
        if wanted:
            raise
        print(f'without keyframes: {error}', flush=True)
        return None
