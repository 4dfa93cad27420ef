# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the two nodes, and the options made from them."""

import math
from collections.abc import Mapping
from typing import Any

from cliploc_ros.core.fit.rig import MAX_FRAMES
from cliploc_ros.core.options import (
    ALGORITHMS,
    COMPARED,
    CROPS,
    MATCHINGS,
    RelocalizerOptions,
)
from cliploc_ros.errors import OptionsError
from cliploc_ros.models.devices import INFERENCES
from cliploc_ros.models.profiles import PROFILE_NAMES
from cliploc_ros.ros.conversions import DETECTION_TYPES
from cliploc_ros.ros.inputs.vertical import SOURCES
from cliploc_ros.ros.node.parameters import ParameterRow, Value

TRANSPORTS = ('raw', 'compressed')
MODES = ('on_request', 'continuous')

# Of timeout_s, for algorithms other than auto.
_SEARCH_SHARE = 0.5

_AUTOSTART = ParameterRow(
    'autostart', True, 'Configure and activate at start-up; false: wait for a lifecycle manager.',
    read_only=True)
_STALE_AFTER = ParameterRow(
    'stale_after_s', 2.0, 'The diagnostics warn of an input that is silent for longer.',
    unit='s', low=0.1, high=3600.0)
_IMAGE_TRANSPORT = ParameterRow(
    'image_transport', 'raw', "Subscribe to 'image' or to 'image/compressed'.",
    choices=TRANSPORTS, read_only=True)
_DEVICE = ParameterRow(
    'device', 'auto', "Where the network runs: 'auto' (a GPU if there is one), 'cpu', 'cuda' or "
    "'cuda:N'.", read_only=True)
_INFERENCE = ParameterRow(
    'inference', 'auto', "What runs the network: 'auto' (OpenVINO on a CPU where it is installed, "
    "else PyTorch), 'pytorch' or 'openvino'.", choices=INFERENCES, read_only=True)
_CACHE_DIR = ParameterRow(
    'cache_dir', '', 'Folder of downloads, label embeddings, converted networks and compiled '
    'kernels; empty: ~/.cache/cliploc_ros.', read_only=True)

DETECTOR = (
    ParameterRow('profile', 'auto', "Detector of a profile: 'accurate', 'balanced' or 'fast'; "
                 "'auto': accurate on a GPU, balanced on a CPU.", choices=PROFILE_NAMES,
                 read_only=True),
    ParameterRow('model', '', 'Weights: a local file, a folder with an OpenVINO export, or a name '
                 "that ultralytics downloads once; empty: the profile's.", read_only=True),
    ParameterRow('conf', 0.1, 'Drop detections below this confidence.',
                 low=0.0, high=1.0),
    ParameterRow('iou', 0.7, 'Drop the weaker of two boxes of one class that overlap more.',
                 low=0.0, high=1.0),
    ParameterRow('imgsz', 640, 'Longer side of the image as the network sees it.',
                 unit='px', low=32, high=4096),
    ParameterRow('max_det', 100, 'Publish only the most confident detections, this many.',
                 low=1, high=1000),
    _DEVICE,
    _INFERENCE,
    _CACHE_DIR,
    _IMAGE_TRANSPORT,
    _AUTOSTART,
    _STALE_AFTER,
)

RELOCALIZER = (
    ParameterRow('map_file', '', "Map file, read when the node is configured and by reload_map: "
                 "a path, or package://PACKAGE/PATH in a package's share folder; "
                 "empty: map_files, or the parameters below 'map', hold the map."),
    ParameterRow('map_files', [''], 'Map files of floors and buildings instead of map_file: a '
                 'request searches all of them. Each has a frame_id of its own, which names the '
                 'map in answers and poses.'),
    ParameterRow('keyframes_file', 'auto', "Layer of keyframes of the map, read with it: a file, "
                 "or 'auto': NAME.keyframes.npz next to map_file NAME.yaml, where there is one; "
                 'empty: none.'),
    ParameterRow('mode', 'on_request', 'Localize on request, or with every '
                 'frame.', choices=MODES, read_only=True),
    ParameterRow('timeout_s', 10.0, 'A request is answered within this time.', unit='s',
                 low=0.1, high=3600.0),
    ParameterRow('matching', 'hybrid', 'Correspondence candidates: equal classes, similarity by '
                 'CLIP, or CLIP with classes for verification.', choices=MATCHINGS,
                 read_only=True),
    ParameterRow('algorithm', 'auto', 'How minimal samples are chosen: auto tries all '
                 "compatible ones, the likeliest first; bf tries all; the others are the paper's.",
                 choices=ALGORITHMS),
    ParameterRow('k', 3, 'Landmarks retrieved for each crop.', low=1, high=1000),
    ParameterRow('iterations', 10_000, 'Try at most this many minimal samples per frame.', low=1,
                 high=1_000_000),
    ParameterRow('iou_threshold', 0.2, 'IoU above which a detection matches a landmark.',
                 low=0.0, high=1.0),
    ParameterRow('random_seed', 0, 'Equal seeds repeat results; below 0, every search differs.'),
    ParameterRow('time_budget_ms', 50.0, 'Limit of search and refinement with auto. The other '
                 'algorithms have half of timeout_s; a search that is cut short is refused.',
                 unit='ms', low=1.0, high=3.6e6),
    ParameterRow('gravity', 'none', 'Source of the vertical: base_frame (the robot stands '
                 'upright) or the topic imu. auto then needs two objects instead of three.',
                 choices=SOURCES, read_only=True),
    ParameterRow('tilt_deviation_deg', 40.0, 'Standard deviation of the tilt of the camera off '
                 'upright, where no vertical is known; 0: any tilt is as likely, as where the '
                 "map's z axis is not up.", unit='deg', low=0.0, high=60.0),
    ParameterRow('vertical_deviation_deg', 1.0, 'Standard deviation of that vertical.',
                 unit='deg', low=0.01, high=45.0),
    ParameterRow('height_range_m', [0.0, 0.0], 'Least and greatest height of the camera in the '
                 'map; equal values: any height.', unit='m'),
    ParameterRow('max_tilt_deg', 180.0, 'Greatest tilt of the camera off upright; 180: '
                 'any.', unit='deg', low=0.0, high=180.0),
    ParameterRow('refine', True, 'Refine the best poses on all of their inliers; the paper does '
                 'not.'),
    ParameterRow('min_inliers', 3, 'Refuse a pose with fewer inliers.', low=3,
                 high=1000),
    ParameterRow('min_confidence', 0.9, 'Refuse a pose that is less likely to be within 1 m of '
                 'the truth.', low=0.0, high=1.0),
    ParameterRow('fuse_frames', 5, 'Localize with up to this many frames together where odom '
                 'links them; 1: each frame alone.', low=1, high=MAX_FRAMES),
    ParameterRow('fuse_window_s', 5.0, 'Drop frames older than this from fusion.', unit='s',
                 low=0.1, high=60.0),
    ParameterRow('detections_type', 'vision_msgs', 'Package of the type of detections: '
                 'vision_msgs/Detection2DArray or yolo_msgs/DetectionArray (yolo_ros).',
                 choices=DETECTION_TYPES, read_only=True),
    ParameterRow('class_map', '', "The map's names for another detector's classes, such as "
                 "'tvmonitor=tv, pottedplant=potted plant'."),
    ParameterRow('crops', 'on_demand', 'Crops that CLIP sees: all, or on demand: the most '
                 'informative first, until the pose is accepted. matching hybrid with algorithm '
                 'auto only; else all.', choices=CROPS),
    ParameterRow('max_detections', 50, 'Use only the most confident detections, this many.',
                 low=3, high=1000),
    ParameterRow('profile', 'auto', "Encoder of a profile: 'accurate', 'balanced' or 'fast'; "
                 "'auto': accurate on a GPU, balanced on a CPU.", choices=PROFILE_NAMES,
                 read_only=True),
    ParameterRow('clip_model', '', 'Architecture: an open_clip name, or a model config (.json); '
                 "empty: the profile's.", read_only=True),
    ParameterRow('clip_pretrained', '', 'Weights: a tag of open_clip, or a local file; empty: the '
                 "profile's, or openai with a clip_model.", read_only=True),
    ParameterRow('clip_checkpoint_path', '', 'Local file with the weights of that tag; empty: '
                 'download them once.', read_only=True),
    ParameterRow('landmark_embeddings', 'image', "What crops are compared with: the map's labels "
                 "('text'), the images next to map_file ('image'), or both. Without images of "
                 'this CLIP: labels.', choices=COMPARED, read_only=True),
    _DEVICE,
    _INFERENCE,
    _CACHE_DIR,
    _IMAGE_TRANSPORT,
    _AUTOSTART,
    _STALE_AFTER,
    ParameterRow('record_folder', '', 'Folder where ~/record stores the last request; empty: keep '
                 'no frames.', read_only=True),
    ParameterRow('record_limit_mb', 1000, 'Record nothing more once that folder holds this much.',
                 unit='MiB', low=1, high=1_000_000),
    ParameterRow('rectified', False, 'The image is rectified: use P of camera_info and no '
                 'distortion.'),
    ParameterRow('base_frame', '', 'Coordinate frame to publish the pose of; empty: the camera.'),
    ParameterRow('base_from_camera', [0.0] * 7, 'Mount of the camera on base_frame: x, y, z [m] '
                 'and quaternion x, y, z, w; all zeros: ask tf2.', unit='m'),
    ParameterRow('max_speed_m_s', 0.1, 'Withhold initialpose while odom shows a faster '
                 'robot.', unit='m/s', low=0.0, high=100.0),
    ParameterRow('max_turn_rad_s', 0.2, 'Withhold initialpose while odom shows a faster '
                 'turn.', unit='rad/s', low=0.0, high=100.0),
    ParameterRow('nomotion_updates', 10, 'Call request_nomotion_update this often after '
                 "initialpose, where it is served, so that AMCL's particles converge.",
                 low=0, high=100),
    ParameterRow('require_localizer', True, 'A request succeeds only if a localizer such as AMCL '
                 'takes its pose; false: without one, for ~/pose or publish_tf.'),
    ParameterRow('localizer_pose', 'amcl_pose', 'Topic where the localizer shows its pose: it has '
                 'to agree with the one on initialpose. Empty: any subscriber of initialpose will '
                 'do.', read_only=True),
    ParameterRow('publish_tf', False, 'Broadcast map -> odom_frame (REP 105) after an accepted '
                 'pose; only where no other localizer does.',
                 read_only=True),
    ParameterRow('odom_frame', 'odom', 'Coordinate frame of odometry, for publish_tf.'),
    ParameterRow('tf_timeout_s', 0.5, "Wait this long for a transform at the image's stamp. A "
                 "request waits for the camera's mount on base_frame until timeout_s.",
                 unit='s', low=0.0, high=60.0),
)


def relocalizer_options(values: Mapping[str, Value]) -> RelocalizerOptions:
    """Return the method's options from the values of the relocalizer's parameters.

    Raises
    ------
    OptionsError
        Names the parameter and its allowed values.
    """
    names = RelocalizerOptions.__dataclass_fields__.keys() - {'time_budget_s'}
    mount = values['base_from_camera']
    assert isinstance(mount, list)
    if any(mount) and abs(math.hypot(*mount[3:]) - 1.0) > 0.01:
        raise OptionsError(f'base_from_camera: the quaternion {mount[3:]} is not of unit length')
    parse_class_map(str(values['class_map']))
    if values['gravity'] == 'base_frame' and not values['base_frame']:
        raise OptionsError("gravity: 'base_frame' needs the parameter base_frame")
    if values['publish_tf'] and not values['base_frame']:
        raise OptionsError('publish_tf: needs the parameter base_frame')
    given: dict[str, Any] = {name: values[name] for name in names}
    budget_ms, timeout_s = values['time_budget_ms'], values['timeout_s']
    assert isinstance(budget_ms, float) and isinstance(timeout_s, float)
    # A search of the paper's algorithms that is cut short is refused, so they get more time; the
    # rest of the request waits for frames, runs the networks and hands over.
    given['time_budget_s'] = budget_ms / 1e3 if values['algorithm'] == 'auto' \
        else _SEARCH_SHARE * timeout_s
    given['height_range_m'] = _height_range(values['height_range_m'])
    return RelocalizerOptions(**given)


def parse_class_map(text: str) -> dict[str, str]:
    """Return the map's class name for each of the detector's that has another.

    Raises
    ------
    OptionsError
        A pair has not the form theirs=ours, or a name occurs twice.
    """
    found: dict[str, str] = {}
    for pair in filter(None, map(str.strip, text.split(','))):
        theirs, sign, ours = (part.strip() for part in pair.partition('='))
        if not (theirs and sign and ours):
            raise OptionsError(f"class_map: '{pair}' is not of the form theirs=ours")
        if theirs in found:
            raise OptionsError(f"class_map: '{theirs}' occurs twice")
        found[theirs] = ours
    return found


def _height_range(heights: Value) -> tuple[float, float]:
    assert isinstance(heights, list)
    low, high = map(float, heights)
    return (low, high) if low != high else (-math.inf, math.inf)
