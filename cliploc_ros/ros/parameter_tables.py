# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the two nodes, and the options that their values become."""

import math
from collections.abc import Mapping
from typing import Any

from cliploc_ros.core.options import ALGORITHMS, MATCHINGS, RelocalizerOptions
from cliploc_ros.core.relocalizer import MAX_FRAMES
from cliploc_ros.errors import OptionsError
from cliploc_ros.ros.inputs.vertical import SOURCES
from cliploc_ros.ros.node.parameters import ParameterRow, Value

TRANSPORTS = ('raw', 'compressed')
MODES = ('on_request', 'continuous')

_AUTOSTART = ParameterRow(
    'autostart', True, 'Configure and activate by itself; false: a lifecycle manager does.',
    read_only=True)
_STALE_AFTER = ParameterRow(
    'stale_after_s', 2.0, 'An input that is silent for longer is warned of in the diagnostics.',
    unit='s', low=0.1, high=3600.0)
_IMAGE_TRANSPORT = ParameterRow(
    'image_transport', 'raw', "Listen to 'image' or to 'image/compressed'.",
    choices=TRANSPORTS, read_only=True)
_DEVICE = ParameterRow(
    'device', 'auto', "Where the network runs: 'auto' takes a GPU if there is one, else 'cpu', "
    "'cuda' or 'cuda:N'.", read_only=True)
_CACHE_DIR = ParameterRow(
    'cache_dir', '', 'Where downloads and label embeddings are kept; empty: '
    '~/.cache/cliploc_ros.', read_only=True)

DETECTOR = (
    ParameterRow('model', 'yolov8x.pt', 'Weights: a local file, or a name that ultralytics '
                 'downloads once.', read_only=True),
    ParameterRow('conf', 0.1, 'Detections below this confidence are left out.',
                 low=0.0, high=1.0),
    ParameterRow('iou', 0.7, 'Of two boxes of a class that overlap more than this, one stays.',
                 low=0.0, high=1.0),
    ParameterRow('imgsz', 640, 'The longer side of the image that the network sees.',
                 unit='px', low=32, high=4096),
    ParameterRow('max_det', 100, 'The most confident detections published.', low=1, high=1000),
    _DEVICE,
    _CACHE_DIR,
    _IMAGE_TRANSPORT,
    _AUTOSTART,
    _STALE_AFTER,
)

RELOCALIZER = (
    ParameterRow('map_file', '', "A map to load when the node is configured and by reload_map; "
                 "empty: the map stands in the parameters below 'map'."),
    ParameterRow('mode', 'on_request', 'When to localize: when a service is called, or '
                 'continuously.', choices=MODES, read_only=True),
    ParameterRow('timeout_s', 10.0, 'How long a request waits for fresh frames.', unit='s',
                 low=0.1, high=3600.0),
    ParameterRow('matching', 'hybrid', 'What makes a candidate: equal classes, similarity by '
                 'CLIP, or CLIP with classes for verification.', choices=MATCHINGS,
                 read_only=True),
    ParameterRow('algorithm', 'auto', 'How minimal samples are chosen: auto goes through all '
                 "that can be, the likeliest first; bf tries all; the others are the paper's.",
                 choices=ALGORITHMS),
    ParameterRow('k', 3, 'Landmarks retrieved for each crop.', low=1, high=1000),
    ParameterRow('iterations', 10_000, 'The most minimal samples tried for a request.', low=1,
                 high=1_000_000),
    ParameterRow('iou_threshold', 0.2, 'Overlap above which a detection shows a landmark.',
                 low=0.0, high=1.0),
    ParameterRow('random_seed', 0, 'Equal seeds repeat results; below 0 every search differs.'),
    ParameterRow('time_budget_ms', 50.0, 'Search and refinement of auto take no longer; the other '
                 'algorithms have timeout_s, and what they are cut short in is refused.',
                 unit='ms', low=1.0, high=3.6e6),
    ParameterRow('gravity', 'none', 'What tells the vertical: the robot stands upright on '
                 'base_frame, or the topic imu. auto then needs two objects in place of three.',
                 choices=SOURCES, read_only=True),
    ParameterRow('vertical_deviation_deg', 1.0, 'Standard deviation of that vertical.',
                 unit='deg', low=0.01, high=45.0),
    ParameterRow('height_range_m', [0.0, 0.0], 'Least and greatest height of the camera in the '
                 'map; equal: any.', unit='m'),
    ParameterRow('max_tilt_deg', 180.0, 'How far the camera may be tipped off upright; 180: any '
                 'way.', unit='deg', low=0.0, high=180.0),
    ParameterRow('refine', True, 'Improve the best poses on all of their inliers; the paper does '
                 'not.'),
    ParameterRow('min_inliers', 3, 'A pose that explains fewer objects is refused.', low=3,
                 high=1000),
    ParameterRow('min_confidence', 0.99, 'A pose that is within 1 m with less probability is '
                 'refused.', low=0.0, high=1.0),
    ParameterRow('fuse_frames', 5, 'The most frames that are asked about together where odom '
                 'joins them; 1: each alone.', low=1, high=MAX_FRAMES),
    ParameterRow('fuse_window_s', 5.0, 'Older frames are not asked about any more.', unit='s',
                 low=0.1, high=60.0),
    ParameterRow('class_map', '', "The map's names for another detector's classes, such as "
                 "'tvmonitor=tv, pottedplant=potted plant'."),
    ParameterRow('max_detections', 50, 'The most confident detections used.', low=3, high=1000),
    ParameterRow('clip_model', 'ViT-L-14', 'Architecture: an open_clip name, or a model config '
                 '(.json).', read_only=True),
    ParameterRow('clip_pretrained', 'openai', 'Weights: a tag of open_clip, or a local file.',
                 read_only=True),
    ParameterRow('clip_checkpoint_path', '', 'Local file with the weights of that tag; empty: '
                 'download them once.', read_only=True),
    _DEVICE,
    _CACHE_DIR,
    _IMAGE_TRANSPORT,
    _AUTOSTART,
    _STALE_AFTER,
    ParameterRow('rectified', False, 'The image is rectified: take P of camera_info and no '
                 'distortion.'),
    ParameterRow('base_frame', '', "Publish the pose of this frame; empty: the camera's."),
    ParameterRow('base_from_camera', [0.0] * 7, 'Mount of the camera on base_frame: x, y, z [m] '
                 'and quaternion x, y, z, w; all zeros: ask tf2.', unit='m'),
    ParameterRow('max_speed_m_s', 0.1, 'No initialpose is published while odom tells of a faster '
                 'robot.', unit='m/s', low=0.0, high=100.0),
    ParameterRow('max_turn_rad_s', 0.2, 'No initialpose is published while odom tells of a faster '
                 'turn.', unit='rad/s', low=0.0, high=100.0),
    ParameterRow('nomotion_updates', 5, 'How often request_nomotion_update is called after an '
                 'initialpose, where AMCL serves it, so that a standing robot converges.',
                 low=0, high=100),
    ParameterRow('publish_tf', False, 'Broadcast the transform from odom_frame to the map (REP '
                 '105) after each accepted pose; only if no other localizer does.',
                 read_only=True),
    ParameterRow('odom_frame', 'odom', 'What publish_tf ties to the map.'),
    ParameterRow('tf_timeout_s', 0.5, "How long to wait for tf2 at the image's stamp.", unit='s',
                 low=0.0, high=60.0),
)


def relocalizer_options(values: Mapping[str, Value]) -> RelocalizerOptions:
    """Return the method's options from the values of the relocalizer's parameters.

    Raises
    ------
    OptionsError
        Names the option and what it allows.
    """
    names = RelocalizerOptions.__dataclass_fields__.keys() - {'time_budget_s'}
    _check_mount(values['base_from_camera'])
    parse_class_map(str(values['class_map']))
    if values['gravity'] == 'base_frame' and not values['base_frame']:
        raise OptionsError("gravity: 'base_frame' needs the parameter base_frame")
    if values['publish_tf'] and not values['base_frame']:
        raise OptionsError('publish_tf: needs the parameter base_frame')
    given: dict[str, Any] = {name: values[name] for name in names}
    budget_ms, timeout_s = values['time_budget_ms'], values['timeout_s']
    assert isinstance(budget_ms, float) and isinstance(timeout_s, float)
    # what the paper's algorithms are cut short in is refused: they get what a request may take
    given['time_budget_s'] = budget_ms / 1e3 if values['algorithm'] == 'auto' else timeout_s
    given['height_range_m'] = _height_range(values['height_range_m'])
    return RelocalizerOptions(**given)


def parse_class_map(text: str) -> dict[str, str]:
    """Return the map's class name for each of the detector's that has another.

    Raises
    ------
    OptionsError
        A pair is none, or a name stands twice.
    """
    found: dict[str, str] = {}
    for pair in filter(None, map(str.strip, text.split(','))):
        theirs, sign, ours = (part.strip() for part in pair.partition('='))
        if not (theirs and sign and ours):
            raise OptionsError(f"class_map: '{pair}' is not of the form theirs=ours")
        if theirs in found:
            raise OptionsError(f"class_map: '{theirs}' stands twice")
        found[theirs] = ours
    return found


def _height_range(heights: Value) -> tuple[float, float]:
    assert isinstance(heights, list)
    low, high = heights
    return (low, high) if low != high else (-math.inf, math.inf)


def _check_mount(mount: Value) -> None:
    assert isinstance(mount, list)
    if any(mount) and abs(math.hypot(*mount[3:]) - 1.0) > 0.01:
        raise OptionsError(f'base_from_camera: the quaternion {mount[3:]} is not of unit length')
