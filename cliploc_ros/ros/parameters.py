# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All parameters of the two nodes, and the options and map paths that they define."""

import math
import re
from dataclasses import dataclass, replace
from itertools import batched
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory

from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.options import ALGORITHMS, COMPARED, CROPS, MATCHINGS, RelocalizerOptions
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.messages import parse_class_map
from cliploc_ros.models.protocols import PROFILE_NAMES
from cliploc_ros.ros.conversions import DETECTION_TYPES, TAG_TYPES
from cliploc_ros.ros.node.parameters import Parameters, parameter

#: Value of localizer_pose that looks for the localizer
AUTO = 'auto'
_FILE, _PACKAGE = 'file://', 'package://'
# Share of timeout_s that algorithms other than auto may search.
_SEARCH_SHARE = 0.5


@dataclass(frozen=True)
class CommonParameters(Parameters):
    """Parameters that both nodes have."""

    cache_dir: str = parameter('',
        'Folder of downloads, label embeddings, compiled networks and kernels; empty: '
        '~/.cache/cliploc_ros.', read_only=True)
    image_transport: str = parameter('raw',
        'Subscribe to image or to image/compressed.', choices=('raw', 'compressed'),
        read_only=True)
    cameras: list[str] = parameter([''],
        'Names of several cameras, which are the namespaces of their topics; empty: one camera.',
        read_only=True)
    stale_after_s: float = parameter(2.0,
        'Warn in the diagnostics about inputs that are silent for longer.', unit='s', low=0.1,
        high=3600.0)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Return the names of several cameras; empty for a single camera."""
        return tuple(name for name in self.cameras if name)

    def check(self) -> None:
        """Raise OptionsError where values do not fit together; the message names the parameter."""
        names = self.camera_names
        if len(set(names)) < len(names):
            raise OptionsError(f'cameras: a name occurs twice: {", ".join(names)}')
        if len(names) > MAX_FRAMES:
            raise OptionsError(f'cameras: {len(names)} names, at most {MAX_FRAMES} are allowed')
        for name in names:
            if not re.fullmatch('[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*', name):
                raise OptionsError(f"cameras: '{name}' is not a valid namespace of topics")


@dataclass(frozen=True)
class DetectorParameters(CommonParameters):
    """The parameters of the detector."""

    profile: str = parameter('balanced',
        'Detector, if model is empty.', choices=PROFILE_NAMES, read_only=True)
    model: str = parameter('',
        'An ONNX file or a folder with one, OWNER/NAME on the Hugging Face hub, or YOLO weights '
        "(.pt); empty: the profile's model.", read_only=True)
    vocabulary: str = parameter('',
        "Classes of a YOLO-World or YOLOE model: 'map' (the classes and labels of map_file), or "
        "names such as 'mug, office chair'; empty: the model's default classes.", read_only=True)
    map_file: str = parameter('',
        "Map for the vocabulary 'map', read when the node is configured.")
    text_model: str = parameter('',
        'File with the text tower of YOLO-World (CLIP ViT-B-32) or YOLOE (mobileclip_blt.ts); '
        'empty: download it once.', read_only=True)
    conf: float = parameter(0.1, 'Drop detections below this confidence.', low=0.0, high=1.0)
    iou: float = parameter(0.7,
        'If two boxes of one class have a greater IoU, drop the less confident box.', low=0.0,
        high=1.0)
    imgsz: int = parameter(640,
        "Longer side of the network's input. Memory grows with its square.", unit='px', low=32,
        high=2560)
    max_det: int = parameter(100,
        'Publish at most this many detections, the most confident.', low=1, high=1000)

    def check(self) -> None:
        """Raise OptionsError where values do not fit together; the message names the parameter."""
        super().check()
        if self.vocabulary == 'map' and not self.map_file:
            raise OptionsError("vocabulary: 'map' needs the parameter map_file")


@dataclass(frozen=True)
class RelocalizerParameters(CommonParameters):
    """The parameters of the relocalizer."""

    map_file: str = parameter('',
        'Map file, a path or package://PACKAGE/PATH, read when the node is configured and by '
        "reload_map; empty: use map_files, or the parameters below 'map'.")
    map_files: list[str] = parameter([''],
        'Map files of floors and buildings, each with its own frame_id, instead of map_file.')
    keyframes_file: str = parameter('auto',
        "Layer of keyframes; 'auto': NAME.keyframes.npz next to each map NAME.yaml, if they "
        'exist; empty: none.')
    prior_probability: float = parameter(0.9,
        'Probability that a pose on ~/prior is correct.', low=0.0, high=0.99)
    last_pose_file: str = parameter('',
        'File that stores the last pose, which is a prior after a restart; empty: none.',
        read_only=True)
    last_pose_probability: float = parameter(0.8,
        'Probability that the robot is still there after a restart.', low=0.0, high=0.99)
    mode: str = parameter('on_request',
        'Localize on request, or with every frame (continuous).',
        choices=('on_request', 'continuous'), read_only=True)
    timeout_s: float = parameter(10.0,
        'Answer a request within this time.', unit='s', low=0.1, high=3600.0)
    matching: str = parameter('hybrid',
        'Correspondences from classes, from CLIP, or from CLIP with verification by classes.',
        choices=MATCHINGS, read_only=True)
    algorithm: str = parameter('auto',
        'Order of minimal samples; auto: compatible samples, most likely first; bf: brute force, '
        "all samples; the others are the paper's.", choices=ALGORITHMS)
    k: int = parameter(3, 'Landmarks retrieved for each crop.', low=1, high=1000)
    iterations: int = parameter(10_000,
        'Greatest number of minimal samples per frame.', low=1, high=1_000_000)
    iou_threshold: float = parameter(0.2,
        'IoU above which a detection matches a landmark.', low=0.0, high=1.0)
    random_seed: int = parameter(0,
        'Equal seeds give equal results; negative: every search differs.')
    time_budget_ms: float = parameter(50.0,
        'Processor time of search and refinement per camera, with algorithm auto. The other '
        'algorithms have half of timeout_s.', unit='ms', low=1.0, high=3.6e6)
    gravity: str = parameter('none',
        'Source of the vertical: base_frame (the robot stands upright) or the topic imu. Two '
        'objects then suffice.', choices=('none', 'base_frame', 'imu'), read_only=True)
    tilt_deviation_deg: float = parameter(40.0,
        "Standard deviation of the camera's tilt if the vertical is unknown, at least 0.1; 0: all "
        'tilts of camera and base_frame are equally likely.', unit='deg', low=0.0, high=60.0)
    vertical_deviation_deg: float = parameter(1.0,
        'Standard deviation of the vertical; use 2 for a moving accelerometer without gyroscope.',
        unit='deg', low=0.01, high=45.0)
    height_range_m: list[float] = parameter([0.0, 0.0],
        'Least and greatest height of the camera in the map; equal values: any height.', unit='m',
        low=-1e5, high=1e5)
    max_tilt_deg: float = parameter(180.0,
        'Greatest tilt of the camera from upright; 180: any tilt.', unit='deg', low=0.0,
        high=180.0)
    refine: bool = parameter(True, 'Refine the best poses with all inliers; the paper does not.')
    min_inliers: int = parameter(3, 'Refuse a pose with fewer inliers.', low=3, high=1000)
    min_confidence: float = parameter(0.9,
        'Refuse a pose with a lower probability of being within 1 m of the truth.', low=0.0,
        high=1.0)
    fuse_frames: int = parameter(5,
        'Localize with up to this many frames together if odom links them; 1: each frame alone.',
        low=1, high=MAX_FRAMES)
    fuse_window_s: float = parameter(5.0,
        'Do not fuse frames older than this.', unit='s', low=0.1, high=60.0)
    detections_type: str = parameter('vision_msgs',
        'Detection2DArray of vision_msgs, or DetectionArray of yolo_msgs (yolo_ros); none: no '
        'detector, keyframes and tags alone.', choices=DETECTION_TYPES, read_only=True)
    tags_type: str = parameter('image',
        'Where the tags of a map are found: in the image, or on the topic tags by apriltag_ros.',
        choices=TAG_TYPES, read_only=True)
    sync_tolerance_s: float = parameter(0.05,
        'Images of several cameras whose stamps differ by less are localized together.', unit='s',
        low=0.0, high=1.0, read_only=True)
    mount_deviation: list[float] = parameter([0.01, 0.5],
        'Standard deviations of the mounts of several cameras, position [m] and rotation [deg] '
        'per axis.', low=0.0, high=1000.0)
    depth_transport: str = parameter('none',
        "Depth of an RGB-D camera: 'raw' on the topic depth, 'compressed' on "
        'depth/compressedDepth.', choices=('none', 'raw', 'compressed'), read_only=True)
    depth_tolerance_s: float = parameter(0.02,
        'Greatest difference between the stamps of depth and image.', unit='s', low=0.0, high=1.0,
        read_only=True)
    class_map: str = parameter('',
        "The map's names for the classes of another detector: 'tvmonitor=tv, pottedplant=potted "
        "plant'.")
    crops: str = parameter('on_demand',
        'Crops that are compared by CLIP; on_demand: the most informative first, until the pose '
        'is accepted (only for matching hybrid with algorithm auto).', choices=CROPS)
    max_detections: int = parameter(50,
        'Use at most this many detections, the most confident.', low=3, high=1000)
    profile: str = parameter('balanced',
        'Encoder, if none is named below.', choices=PROFILE_NAMES, read_only=True)
    clip_model: str = parameter('',
        'Architecture of open_clip weights, or a model config (.json); not needed for ONNX files.',
        read_only=True)
    clip_pretrained: str = parameter('',
        'A folder with ONNX files, OWNER/NAME on the Hugging Face hub, or a tag or file of '
        "open_clip; empty: the profile's, or openai if clip_model is set.", read_only=True)
    clip_checkpoint_path: str = parameter('',
        'Local file with the weights of the tag clip_pretrained; empty: download them once.',
        read_only=True)
    landmark_embeddings: str = parameter('image',
        "Compare crops with the map's labels, the images next to map_file, or both. Labels are "
        'used if there are no images for this CLIP.', choices=COMPARED, read_only=True)
    record_folder: str = parameter('',
        'Folder where ~/record stores the last request; empty: do not keep frames.',
        read_only=True)
    record_limit_mb: int = parameter(1000,
        'Greatest size of record_folder.', unit='MiB', low=1, high=1_000_000)
    rectified: bool = parameter(False,
        'The image is rectified: use P of camera_info and no distortion.')
    base_frame: str = parameter('', 'Coordinate frame whose pose is published; empty: the camera.')
    base_from_camera: list[float] = parameter([0.0] * 7,
        'Mount of the camera on base_frame: x, y, z [m] and quaternion x, y, z, w. Several '
        'cameras: seven numbers for each. All zeros: look it up in tf2.', unit='m', low=-1000.0,
        high=1000.0, repeats=True)
    max_speed_m_s: float = parameter(0.1,
        'Withhold initialpose while the robot is faster by odom.', unit='m/s', low=0.0, high=100.0)
    max_turn_rad_s: float = parameter(0.2,
        'Withhold initialpose while the robot turns faster by odom.', unit='rad/s', low=0.0,
        high=100.0)
    nomotion_updates: int = parameter(10,
        "Number of calls of AMCL's service request_nomotion_update after initialpose, so that "
        'its particles converge.', low=0, high=100)
    require_localizer: bool = parameter(True,
        'A request succeeds only if a localizer such as AMCL takes its pose; false: no localizer '
        'is needed.')
    localizer_pose: str = parameter(AUTO,
        "Topic of the localizer's pose, which must agree with initialpose; 'auto': found, or in "
        'tf; empty: any subscriber of initialpose suffices.', read_only=True)
    publish_tf: bool = parameter(False,
        'Broadcast map -> odom_frame (REP 105) by all poses and odometry. It pauses while another '
        'node broadcasts it, and while poses contradict each other.', read_only=True)
    odom_frame: str = parameter('odom', 'Coordinate frame of odometry, for publish_tf.')
    watch: str = parameter('none',
        "Check the localizer's pose continuously: map -> base_frame in tf2, or the topic "
        'localizer_pose.', choices=('none', 'tf', 'amcl_pose'), read_only=True)
    watch_period_s: float = parameter(2.0,
        'Time between checks of the watch. A metre or a quarter turn by odom triggers an earlier '
        'check, at most once a second.', unit='s', low=1.0, high=5.0)
    on_lost: str = parameter('report',
        'Reaction to a lost robot: only report it, or relocalize as soon as the robot is at rest '
        'by odom.', choices=('report', 'relocalize'))
    tf_timeout_s: float = parameter(0.5,
        "Longest wait for a transform at the image's stamp. A request waits for the camera's "
        'mount until timeout_s.', unit='s', low=0.0, high=60.0)

    def of_camera(self, name: str) -> 'RelocalizerParameters':
        """Return the parameters with the mount of one camera."""
        if len(self.base_from_camera) == 7 or not name:
            return self
        first = 7 * self.camera_names.index(name)
        return replace(self, base_from_camera=self.base_from_camera[first:first + 7])

    def check(self) -> None:
        """Raise OptionsError where values do not fit together; the message names the parameter."""
        super().check()
        if len(self.base_from_camera) not in (7, 7 * len(self.camera_names)):
            raise OptionsError('base_from_camera: needs 7 numbers, or 7 for each camera')
        for mount in batched(self.base_from_camera, 7):
            if any(mount) and abs(math.hypot(*mount[3:]) - 1.0) > 0.01:
                raise OptionsError(
                    f'base_from_camera: the quaternion {[*mount[3:]]} is not of unit length')
        if self.gravity == 'base_frame' and not self.base_frame:
            raise OptionsError("gravity: 'base_frame' needs the parameter base_frame")
        if self.camera_names and not self.base_frame:
            raise OptionsError('cameras: several cameras need the parameter base_frame')
        if self.publish_tf and not self.base_frame:
            raise OptionsError('publish_tf: needs the parameter base_frame')
        if self.watch == 'amcl_pose' and not self.localizer_pose:
            raise OptionsError("watch: 'amcl_pose' needs the parameter localizer_pose")
        parse_class_map(self.class_map)
        self.options()

    def options(self) -> RelocalizerOptions:
        """Return the method's options.

        OptionsError: names the parameter and its allowed values.
        """
        names = RelocalizerOptions.__dataclass_fields__.keys() - {
            'time_budget_s', 'height_range_m', 'mount_deviation'}
        given: dict[str, Any] = {name: getattr(self, name) for name in names}
        low, high = self.height_range_m
        metres, degrees = self.mount_deviation
        # The paper's algorithms refuse if their search is cut short, so they get more time. The
        # rest of the request waits for frames, runs the networks and delivers the pose.
        return RelocalizerOptions(
            **given, mount_deviation=(metres, degrees),
            height_range_m=(low, high) if low != high else (-math.inf, math.inf),
            time_budget_s=self.time_budget_ms / 1e3 if self.algorithm == 'auto'
            else _SEARCH_SHARE * self.timeout_s)


def path_of(name: str) -> str:
    """Return the path of a map file.

    Parameters
    ----------
    name : str
        A path, ``file:///PATH``, or ``package://PACKAGE/PATH``: a path in the package's share
        folder, as in URDF files.

    Raises
    ------
    MapError
        The package is not installed, or the URL names no file in it.
    """
    if not name.startswith(_PACKAGE):
        return name.removeprefix(_FILE)
    package, _, path = name.removeprefix(_PACKAGE).partition('/')
    if not package or not path:
        raise MapError(f'{name} is not of the form package://PACKAGE/PATH, such as '
                       'package://my_maps/office.yaml')
    try:
        return str(Path(get_package_share_directory(package)) / path)
    except (OSError, LookupError, ValueError) as error:  # OSError: no workspace is sourced
        raise MapError(f"{name}: the package '{package}' is not found: install it, or source "
                       'its workspace') from error


def map_files(parameters: RelocalizerParameters) -> list[str]:
    """Return the paths of the map files in the parameters map_file and map_files.

    Raises
    ------
    OptionsError
        Both parameters name files.
    MapError
        A URL names a package that is not installed.
    """
    several = [name for name in parameters.map_files if name]
    if several and parameters.map_file:
        raise OptionsError("map_file and map_files are both set: set map_file to '' to search all "
                           'maps of map_files')
    return [path_of(name) for name in several or [parameters.map_file] if name]
