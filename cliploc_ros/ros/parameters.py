# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the two nodes; the method's options and the paths of maps made from them."""

import math
import re
from dataclasses import dataclass, replace
from itertools import batched
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory

from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.options import (
    ALGORITHMS,
    COMPARED,
    CROPS,
    MATCHINGS,
    RelocalizerOptions,
)
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.messages import parse_class_map
from cliploc_ros.models.devices import INFERENCES
from cliploc_ros.models.profiles import PROFILE_NAMES
from cliploc_ros.ros.conversions import DETECTION_TYPES
from cliploc_ros.ros.node.parameters import Parameters, parameter

TRANSPORTS = ('raw', 'compressed')
MODES = ('on_request', 'continuous')
VERTICAL_SOURCES = ('none', 'base_frame', 'imu')
WATCHES = ('none', 'tf', 'amcl_pose')
REACTIONS = ('report', 'relocalize')

_FILE, _PACKAGE = 'file://', 'package://'
# Share of timeout_s for the search of algorithms other than auto.
_SEARCH_SHARE = 0.5


@dataclass(frozen=True)
class CommonParameters(Parameters):
    """Parameters that both nodes have."""

    device: str = parameter('auto',
        "Where the network runs: 'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'.",
        read_only=True)
    inference: str = parameter('auto',
        "Engine of the network; 'auto': OpenVINO on a CPU, PyTorch on a GPU.",
        choices=INFERENCES, read_only=True)
    cache_dir: str = parameter('',
        'Folder of downloads, label embeddings, compiled networks and kernels; empty: '
        '~/.cache/cliploc_ros.', read_only=True)
    image_transport: str = parameter('raw',
        'Subscribe to image or to image/compressed.', choices=TRANSPORTS, read_only=True)
    cameras: list[str] = parameter([''],
        'Names of several cameras, the namespaces of their topics; empty: one camera.',
        read_only=True)
    stale_after_s: float = parameter(2.0,
        'Warn in the diagnostics of an input that is silent for longer.', unit='s', low=0.1,
        high=3600.0)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Return the names of several cameras; none where there is one."""
        return tuple(name for name in self.cameras if name)

    def check(self) -> None:
        """Raise OptionsError where values do not fit together; the message names the parameter."""
        names = self.camera_names
        if len(set(names)) < len(names):
            raise OptionsError(f'cameras: a name is given twice: {", ".join(names)}')
        if len(names) > MAX_FRAMES:
            raise OptionsError(f'cameras: {len(names)} are more than {MAX_FRAMES}')
        for name in names:
            if not re.fullmatch('[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*', name):
                raise OptionsError(f"cameras: '{name}' is not a namespace of topics")


@dataclass(frozen=True)
class DetectorParameters(CommonParameters):
    """The parameters of the detector."""

    profile: str = parameter('auto',
        "Detector; 'auto': accurate on a GPU, balanced on a CPU.", choices=PROFILE_NAMES,
        read_only=True)
    model: str = parameter('',
        'An ONNX file or a folder with one, OWNER/NAME of the Hugging Face hub, or YOLO weights '
        "(.pt); empty: the profile's.", read_only=True)
    vocabulary: str = parameter('',
        "What a YOLO-World or YOLOE detects: 'map' (the classes and labels of map_file), or "
        "names such as 'mug, office chair'; empty: its own classes.", read_only=True)
    map_file: str = parameter('',
        "Map of the vocabulary 'map', read when the node is configured.")
    text_model: str = parameter('',
        'Text tower of a YOLO-World (CLIP ViT-B-32) or YOLOE (mobileclip_blt.ts), a file; '
        'empty: download it once.', read_only=True)
    conf: float = parameter(0.1,
        'Drop detections below this confidence.', low=0.0, high=1.0)
    iou: float = parameter(0.7,
        'Drop the weaker of two boxes of one class that overlap more.', low=0.0, high=1.0)
    imgsz: int = parameter(640,
        "Longer side of the network's input. Memory grows with its square.", unit='px', low=32,
        high=2560)
    max_det: int = parameter(100,
        'Most detections published, by confidence.', low=1, high=1000)

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
        "reload_map; empty: map_files, or the parameters below 'map'.")
    map_files: list[str] = parameter([''],
        'Map files of floors and buildings, each with its own frame_id, in place of map_file.')
    keyframes_file: str = parameter('auto',
        "Layer of keyframes; 'auto': NAME.keyframes.npz next to map_file NAME.yaml, if it "
        'exists; empty: none.')
    prior_probability: float = parameter(0.9,
        'Probability that ~/prior is right.', low=0.0, high=0.99)
    last_pose_file: str = parameter('',
        'File that keeps the last pose, a prior after a restart; empty: none.', read_only=True)
    last_pose_probability: float = parameter(0.8,
        'Probability that the robot is still there after a restart.', low=0.0, high=0.99)
    mode: str = parameter('on_request',
        'Localize on request, or with every frame.', choices=MODES, read_only=True)
    timeout_s: float = parameter(10.0,
        'Answer a request within this time.', unit='s', low=0.1, high=3600.0)
    matching: str = parameter('hybrid',
        'Correspondences from classes, from CLIP, or from CLIP with verification by classes.',
        choices=MATCHINGS, read_only=True)
    algorithm: str = parameter('auto',
        'Choice of minimal samples; auto: all compatible samples, most likely first; bf: all; '
        "the others are the paper's.", choices=ALGORITHMS)
    k: int = parameter(3,
        'Landmarks retrieved for each crop.', low=1, high=1000)
    iterations: int = parameter(10_000,
        'Most minimal samples per frame.', low=1, high=1_000_000)
    iou_threshold: float = parameter(0.2,
        'IoU above which a detection matches a landmark.', low=0.0, high=1.0)
    random_seed: int = parameter(0,
        'Equal seeds repeat results; below 0, every search differs.')
    time_budget_ms: float = parameter(50.0,
        'Processor time of search and refinement for each camera, with auto. The other '
        'algorithms have half of timeout_s.', unit='ms', low=1.0, high=3.6e6)
    gravity: str = parameter('none',
        'Source of the vertical: base_frame (the robot stands upright) or the topic imu. Two '
        'objects then suffice.', choices=VERTICAL_SOURCES, read_only=True)
    tilt_deviation_deg: float = parameter(40.0,
        "Standard deviation of the camera's tilt where no vertical is known; 0: any tilt is "
        'equally likely.', unit='deg', low=0.0, high=60.0)
    vertical_deviation_deg: float = parameter(1.0,
        'Standard deviation of the vertical; 2 for an accelerometer alone that moves.',
        unit='deg', low=0.01, high=45.0)
    height_range_m: list[float] = parameter([0.0, 0.0],
        'Least and greatest height of the camera in the map; equal values: any.', unit='m')
    max_tilt_deg: float = parameter(180.0,
        'Greatest tilt of the camera off upright; 180: any.', unit='deg', low=0.0, high=180.0)
    refine: bool = parameter(True,
        'Refine the best poses on all inliers; the paper does not.')
    min_inliers: int = parameter(3,
        'Refuse a pose with fewer inliers.', low=3, high=1000)
    min_confidence: float = parameter(0.9,
        'Refuse a pose that is less likely to be within 1 m of the truth.', low=0.0, high=1.0)
    fuse_frames: int = parameter(5,
        'Most frames localized together where odom links them; 1: each alone.', low=1,
        high=MAX_FRAMES)
    fuse_window_s: float = parameter(5.0,
        'Fuse no frames older than this.', unit='s', low=0.1, high=60.0)
    detections_type: str = parameter('vision_msgs',
        'Detection2DArray of vision_msgs, or DetectionArray of yolo_msgs (yolo_ros).',
        choices=DETECTION_TYPES, read_only=True)
    sync_tolerance_s: float = parameter(0.05,
        'Images of several cameras within this time belong to one instant.', unit='s', low=0.0,
        high=1.0, read_only=True)
    mount_deviation: list[float] = parameter([0.01, 0.5],
        'Standard deviations of the mounts of several cameras on each axis [m] [deg].')
    depth_transport: str = parameter('none',
        "Depth of an RGB-D camera: 'raw' on the topic depth, 'compressed' on "
        'depth/compressedDepth.', choices=('none', 'raw', 'compressed'), read_only=True)
    depth_tolerance_s: float = parameter(0.02,
        'Greatest difference between the stamps of depth and image.', unit='s', low=0.0, high=1.0,
        read_only=True)
    class_map: str = parameter('',
        "The map's names for another detector's classes: 'tvmonitor=tv, pottedplant=potted "
        "plant'.")
    crops: str = parameter('on_demand',
        'Crops that CLIP sees; on_demand: the most informative first, until the pose is '
        'accepted (matching hybrid with algorithm auto only).', choices=CROPS)
    max_detections: int = parameter(50,
        'Most detections used, by confidence.', low=3, high=1000)
    profile: str = parameter('auto',
        "Encoder; 'auto': accurate on a GPU, balanced on a CPU.", choices=PROFILE_NAMES,
        read_only=True)
    clip_model: str = parameter('',
        'Architecture of weights of open_clip, or a model config (.json); ONNX files need none.',
        read_only=True)
    clip_pretrained: str = parameter('',
        'A folder with ONNX files, OWNER/NAME of the Hugging Face hub, or a tag or file of '
        "open_clip; empty: the profile's, or openai with a clip_model.", read_only=True)
    clip_checkpoint_path: str = parameter('',
        'Local file with the weights of the tag clip_pretrained; empty: download them once.',
        read_only=True)
    landmark_embeddings: str = parameter('image',
        "Crops are compared with the map's labels, the images next to map_file, or both. "
        'Without images of this CLIP: labels.', choices=COMPARED, read_only=True)
    record_folder: str = parameter('',
        'Folder where ~/record stores the last request; empty: keep no frames.', read_only=True)
    record_limit_mb: int = parameter(1000,
        'Most that record_folder holds.', unit='MiB', low=1, high=1_000_000)
    rectified: bool = parameter(False,
        'The image is rectified: use P of camera_info and no distortion.')
    base_frame: str = parameter('',
        'Coordinate frame to publish the pose of; empty: the camera.')
    base_from_camera: list[float] = parameter([0.0] * 7,
        'Mount of the camera on base_frame: x, y, z [m] and quaternion x, y, z, w; seven '
        'numbers for each of several cameras; all zeros: ask tf2.', unit='m', repeats=True)
    max_speed_m_s: float = parameter(0.1,
        'Withhold initialpose while odom shows a faster robot.', unit='m/s', low=0.0, high=100.0)
    max_turn_rad_s: float = parameter(0.2,
        'Withhold initialpose while odom shows a faster turn.', unit='rad/s', low=0.0, high=100.0)
    nomotion_updates: int = parameter(10,
        "Calls of request_nomotion_update after initialpose, where it is served, so that AMCL's"
        ' particles converge.', low=0, high=100)
    require_localizer: bool = parameter(True,
        'A request succeeds only if a localizer such as AMCL takes its pose; false: without '
        'one.')
    localizer_pose: str = parameter('amcl_pose',
        'Topic where the localizer shows its pose, which has to agree with initialpose; empty: '
        'any subscriber of initialpose will do.', read_only=True)
    publish_tf: bool = parameter(False,
        'Broadcast map -> odom_frame (REP 105) after an accepted pose; only where no other '
        'localizer does.', read_only=True)
    odom_frame: str = parameter('odom',
        'Coordinate frame of odometry, for publish_tf.')
    watch: str = parameter('none',
        "Watch whether the localizer's pose is right: map -> base_frame of tf2, or the topic "
        'localizer_pose.', choices=WATCHES, read_only=True)
    watch_period_s: float = parameter(2.0,
        'Time between looks. A metre or a quarter turn of odom brings the next one forward, to '
        'once a second at most.', unit='s', low=1.0, high=5.0)
    on_lost: str = parameter('report',
        'When the watch finds the robot lost: report it only, or relocalize once odom shows '
        'that it stands.', choices=REACTIONS)
    tf_timeout_s: float = parameter(0.5,
        "Longest wait for a transform at the image's stamp. A request waits for the camera's "
        'mount until timeout_s.', unit='s', low=0.0, high=60.0)

    def of_camera(self, name: str) -> 'RelocalizerParameters':
        """Return the parameters with the mount of one of several cameras."""
        if len(self.base_from_camera) == 7 or not name:
            return self
        first = 7 * self.camera_names.index(name)
        return replace(self, base_from_camera=self.base_from_camera[first:first + 7])

    def check(self) -> None:
        """Raise OptionsError where values do not fit together; the message names the parameter."""
        super().check()
        if len(self.base_from_camera) not in (7, 7 * len(self.camera_names)):
            raise OptionsError('base_from_camera: needs 7 numbers, or 7 for each of the cameras')
        for mount in batched(self.base_from_camera, 7):
            if any(mount) and abs(math.hypot(*mount[3:]) - 1.0) > 0.01:
                raise OptionsError(
                    f'base_from_camera: the quaternion {[*mount[3:]]} is not of unit length')
        if self.gravity == 'base_frame' and not self.base_frame:
            raise OptionsError("gravity: 'base_frame' needs the parameter base_frame")
        if self.camera_names and not self.base_frame:
            raise OptionsError('cameras: needs base_frame')
        if len(self.mount_deviation) != 2 or not all(
                0.0 <= one < math.inf for one in self.mount_deviation):
            raise OptionsError('mount_deviation: needs two numbers of 0 or more')
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
        # A search of the paper's algorithms that is cut short is refused, so they get more time;
        # the rest of the request waits for frames, runs the networks and hands over.
        return RelocalizerOptions(
            **given, mount_deviation=(metres, degrees),
            height_range_m=(low, high) if low != high else (-math.inf, math.inf),
            time_budget_s=self.time_budget_ms / 1e3 if self.algorithm == 'auto'
            else _SEARCH_SHARE * self.timeout_s)


def path_of(name: str) -> str:
    """Return the path of a map.

    Parameters
    ----------
    name : str
        A path; ``file:///PATH``; or ``package://PACKAGE/PATH``, a path in the package's share
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
        raise MapError(f'{name}: no package://PACKAGE/PATH, such as package://my_maps/office.yaml')
    try:
        return str(Path(get_package_share_directory(package)) / path)
    except (OSError, LookupError, ValueError) as error:  # OSError: no workspace is sourced
        raise MapError(f"{name}: there is no package '{package}' here: install it, or source "
                       'the workspace that has it') from error


def map_files(parameters: RelocalizerParameters) -> list[str]:
    """Return the paths of the files that the parameters map_file and map_files name.

    Raises
    ------
    OptionsError
        Both parameters name files.
    MapError
        A URL names a package that is not installed.
    """
    several = [name for name in parameters.map_files if name]
    if several and parameters.map_file:
        raise OptionsError("map_file and map_files both name files: set map_file to '' to search "
                           'all of map_files')
    return [path_of(name) for name in several or [parameters.map_file] if name]
