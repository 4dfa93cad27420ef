# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relocalize frames with a map and networks that stay loaded between requests.

The messages of an instant become a query; their consistency is checked.
"""

import hashlib
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros import messages
from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.geometry.camera_faults import Fault, check_faults
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.kernels.compiled import KernelCache
from cliploc_ros.core.keyframes.layer import layer_hash, layer_path, load_layers
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer, by_classes, can_do_without_crops
from cliploc_ros.core.map.joined_map import join_maps, parts_of, place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer, in_its_map
from cliploc_ros.core.watch.watch import Watch, WatchReport
from cliploc_ros.errors import CliplocError, MapError, ModelError
from cliploc_ros.files.storage import read_file, resolve_cache_dir
from cliploc_ros.models.protocols import with_encoder
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters, map_files
from cliploc_ros.ros.visualization import SeenImage

if TYPE_CHECKING:  # loaded where crops are compared
    from cliploc_ros.models.observer import Observer

logger = logging.getLogger(__name__)

#: Value of keyframes_file that selects the layer next to the map, if it exists.
NEXT_TO_MAP = 'auto'
_DIGITS = 12
# The vertical in the frame of a body that is tilted by less than 45 degrees and rolled by less
# than 17. In an optical frame, only a camera that looks up by more than 72 degrees has it there.
_LEAST_Z, _MOST_Y = 0.7, 0.3


class Keyframes(NamedTuple):
    """The keyframes of the maps, and their files and hashes for the diagnostics."""

    localizer: KeyframeLocalizer
    file: str = ''
    file_hash: str = ''


class Localized(NamedTuple):
    """The result of one frame."""

    #: In the coordinate frame of the map.
    found: Relocalization
    #: With several maps, the map of the best pose.
    landmark_map: LandmarkMap
    #: The image, the compared crops and their similarities to this map.
    seen: SeenImage
    #: Covariance (6, 6) for a filter that fuses all accepted poses, see Localizer.follow.
    for_filter: NDArray[np.float64] | None
    #: (4, 4): the camera by all answers and odometry, see Localizer.track; without odometry, by
    #: this accepted answer. None if it is unknown, in doubt or in another map.
    carried: NDArray[np.float64] | None
    #: Names of cameras without a frame, or with a frame of another run of odometry.
    left_out: tuple[str, ...]
    query: Query  #: Reproduces the answer


class FrameLocalizer:
    """Localizes frames in a map.

    Parameters
    ----------
    observer : Observer, optional
        Compares crops with the map's labels and images. None if only classes are matched.
    relocalizer : Relocalizer
        Relocalizer of the map, with these options.
    map_hash : str
        See load_map.
    keyframes : Keyframes, optional
        The layer of keyframes of the map.
    """

    def __init__(self, landmark_map: LandmarkMap, observer: 'Observer | None',
                 relocalizer: Relocalizer, options: RelocalizerOptions, map_hash: str,
                 keyframes: Keyframes | None = None) -> None:
        self.map_hash, self.keyframes = map_hash, keyframes
        #: The map, or all maps joined, and the coordinate frames of the maps
        self.landmark_map = landmark_map
        self.frame_ids = [part.landmark_map.frame_id for part in parts_of(landmark_map)]
        self.grids: dict[str, str] = {}  #: File of Nav2's grid of each of these frames
        self.observer = observer
        self.instants = Instants(landmark_map, options.matching != 'clip')
        self._options, self.watch = options, Watch(relocalizer)
        self.localizer = Localizer(relocalizer, None if keyframes is None else keyframes.localizer)
        relocalizer.warm_up()

    @property
    def description(self) -> str:
        """Return map, keyframes, matching and algorithm in one line."""
        frames = ', '.join(f"'{frame_id}'" for frame_id in self.frame_ids)
        where = f'frame {frames}' if len(self.frame_ids) == 1 else \
            f'{len(self.frame_ids)} maps, frames {frames}'
        keyframes = '' if self.keyframes is None else \
            f'{len(self.keyframes.localizer.layer)} keyframes, '
        return (f'{len(self.landmark_map)} landmarks in {where}, {keyframes}'
                f'matching {self._options.matching}, algorithm {self._options.algorithm}')

    def localize(self, frame: Frame, parameters: RelocalizerParameters, known: KnownBefore,
                 times: StageTimes, deadline: float = math.inf) -> Localized:
        """Localize the camera with a frame and the earlier frames that odometry links to it.

        `parameters` are the current ones, `known` is the prior knowledge. No crops are compared
        after `deadline` (monotonic clock) [s].

        CliplocError: the frame or the parameters are invalid.
        """
        times.begin('decoding')
        # a frame without a deadline is one of a stream: no thorough search, the next one follows
        query = replace(self.instants.query(frame, parameters, known),
                        is_thorough=not math.isinf(deadline))
        found = self.answer(query, parameters.options(), times, deadline)
        assert self.localizer.query is not None
        query, seen = self.localizer.query, self.localizer.query.newest
        for_filter = found.covariance
        # the result of a request that is late is not published, and must not advance the track
        if time.monotonic() < deadline:
            added = self.localizer.follow(found, not math.isinf(deadline))
            for_filter = added if parameters.mode == 'continuous' else for_filter
        found, own = in_its_map(self.instants.explained(found), self.landmark_map)
        track, carried = self.localizer.track, found.map_from_camera if found.accepted else None
        if track is not None:
            place = place_of(self.landmark_map, track.map_from_camera)
            carried = place.map_from_camera if track.contradicting is None \
                and place.part.landmark_map is own.landmark_map else None
        if seen.similarities is not None and len(self.frame_ids) > 1:
            seen = replace(seen, similarities=np.asarray(seen.similarities)[
                :, own.first:own.first + len(own.landmark_map)])
        names = [camera_frame.camera_name for camera_frame in query.frames]
        layer = None if self.keyframes is None else self.keyframes.localizer.layer
        return Localized(
            found, own.landmark_map, SeenImage(query.images[-1], seen, layer), for_filter, carried,
            (*frame.left_out, *(beside.camera for beside, _ in known.beside
                                            if beside.camera not in names)), query)

    def answer(self, query: Query, options: RelocalizerOptions, times: StageTimes,
               deadline: float = math.inf) -> Relocalization:
        """Answer a query with the current options; see localize."""
        localizer = self._localizer_for(options)
        if self.keyframes is not None:
            self.instants.note(self.keyframes.localizer.layer.camera_note(query.newest.camera))
        times.begin('search')
        found = localizer.answer(query, self.observer, deadline, times.begin)
        for name in localizer.cameras.wrong_mounts:
            self.instants.note(f'detections of {name} contradict the other cameras: check its '
                               'mount, camera_info and image')
        if localizer.depth_scale.is_wrong:
            self.instants.note(
                f'depth is {localizer.depth_scale.ratio:.2f} times the depth by boxes and map, '
                'and no longer used: check its unit, calibration and registration')
        return found

    def look(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
             frame_id: str, map_from_camera: NDArray[np.float64]) -> WatchReport:
        """Check the localizer's camera pose (4, 4) in the map `frame_id` against a frame.

        Only crops whose embeddings are already known are compared. Other arguments as for
        localize.

        CliplocError: the frame or the parameters are invalid.
        """
        shift = next((part.shift for part in parts_of(self.landmark_map)
                      if part.landmark_map.frame_id == frame_id), None)
        if shift is None:
            raise MapError(f"no map is in frame '{frame_id}', only in "
                           f"{', '.join(self.frame_ids)}: correct the map's frame_id")
        options = parameters.options()
        localizer = self._localizer_for(options)
        query = localizer.with_tags(self.instants.query(frame, parameters, KnownBefore(state)))
        observation = localizer.with_free_crops(query, 0, self.observer) \
            if can_do_without_crops(options) else by_classes(query.newest, len(self.landmark_map))
        pose = map_from_camera.copy()
        pose[:3, 3] += shift
        return self.watch.look(observation, pose, query.images[-1], localizer.recognizer(query))

    def _localizer_for(self, options: RelocalizerOptions) -> Localizer:
        """Return the localizer. If the options changed, it uses them, and the watch is new."""
        if options != self._options:
            relocalizer = Relocalizer(self.landmark_map, options)
            self._options, self.watch = options, Watch(relocalizer)
            self.localizer.use(relocalizer)
        return self.localizer


class Instants:
    """Converts frames to queries, and checks cameras and detector.

    Parameters
    ----------
    by_class : bool
        Whether the classes of detections are compared with the classes of the map.
    """

    def __init__(self, landmark_map: LandmarkMap, by_class: bool) -> None:
        self._detector = DetectorCheck(landmark_map, by_class)
        self._faults: dict[str, list[Fault]] = {}  # of the newest frame of each camera
        self.notes: list[str] = []  #: All warnings that are no faults, each once

    @property
    def faults(self) -> list[Fault]:
        """Return the faults of the newest frames, their cameras and their detector."""
        return [*(fault._replace(text=f'{name}: {fault.text}' if name else fault.text)
                  for name, faults in self._faults.copy().items() for fault in faults),
                *(fault._replace(text=f'the detector: {fault.text}')
                  for fault in self._detector.faults)]

    def query(self, frame: Frame, parameters: RelocalizerParameters, known: KnownBefore) -> Query:
        """Return the query of an instant, without cameras whose odometry is of another run.

        CliplocError: the frame or the parameters are invalid.
        """
        state, beside, region = known
        # without odometry, the cameras of one instant are linked by their mounts
        run = _run_of(state)
        by_odometry = run is not None or not (frame.camera and beside)
        images, observations = zip(*(
            self._observed(camera_frame, parameters, camera_state, by_odometry)
            for camera_frame, camera_state in (*beside, (frame, state))
            if run == _run_of(camera_state)), strict=True)
        newest = replace(observations[-1], region=region)
        others = (replace(other, stamp_ns=newest.stamp_ns) for other in observations[:-1])
        return Query((*others, newest), images, run, parameters.fuse_frames,
                     parameters.fuse_window_s)

    def explained(self, found: Relocalization) -> Relocalization:
        """Return a result; a refusal gets the faults of the newest frames as further reasons."""
        if found.accepted:
            return found
        found = self._detector.explain(found)
        texts = (fault.text for fault in self.faults if not fault.is_certain)
        return replace(found, reason='; '.join([found.reason, *texts]))

    def note(self, text: str) -> None:
        """Log a warning once."""
        if text and text not in self.notes:
            self.notes.append(text)
            logger.warning('%s', text)

    def _observed(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
                  by_odometry: bool) -> tuple[NDArray[np.uint8], Observation]:
        """Return the image of a frame and its detections, without crops."""
        try:
            image = messages.image_from_msg(frame.image)
            height, width = image.shape[:2]
            image_frame, info = frame.image.header.frame_id, frame.camera_info
            camera = messages.camera_from_msg(info, (width, height), parameters.rectified)
            given = messages.detections_from_msg(
                frame.detections, messages.parse_class_map(parameters.class_map))
            faults = [
                *messages.faults_of_headers(image_frame, info.header.frame_id,
                                            frame.detections.header.frame_id),
                *messages.faults_of_camera_info(info, camera, parameters.rectified),
                *messages.faults_of_rectified(frame.image_topic, parameters.rectified, info),
                *(faults_of_axes(image_frame, state.camera_from_base)
                  if parameters.base_frame not in ('', image_frame) else [])]
            check_faults(faults)
        except CliplocError as error:
            self._faults[frame.camera] = [Fault(str(error), True)]
            raise
        self._faults[frame.camera] = faults
        detections = given.usable(camera.width, camera.height, parameters.max_detections)
        if parameters.detections_type != 'none':
            self._detector.add(given, detections)
        tags = None if frame.tags is None else messages.tags_from_msg(frame.tags)
        place, odom_from_camera = state.place, None
        if not by_odometry:
            odom_from_camera = invert_transform(state.camera_from_base)
        elif place is not None:
            odom_from_camera = place.odom_from_frame
        depths = None
        try:
            if frame.depth is not None:
                depths = messages.depths_from_msg(
                    frame.depth, frame.image.header.frame_id, camera, detections.bboxes_xyxy,
                    frame.depth_camera_info, state.camera_from_depth)
            elif parameters.depth_transport != 'none':
                self.note('no depth within depth_tolerance_s '
                          f'({parameters.depth_tolerance_s:g} s): remap depth, start its '
                          'publisher, or set depth_transport to none')
        except CliplocError as error:
            self.note(f'localizing without depth: {error}')
        return image, Observation(
            camera, detections, stamp_ns=frame.stamp_ns, camera_name=frame.camera,
            up_in_camera=state.up_in_camera, depths=depths,
            odom_from_camera=odom_from_camera, odom_way_m=0.0 if place is None else place.way_m,
            base_up_in_camera=state.camera_from_base[:3, 2]
            if parameters.base_frame not in ('', image_frame) else None, tags=tags)


def _run_of(state: RobotState) -> int | None:
    return None if state.place is None else state.place.run


def faults_of_axes(frame_id: str, camera_from_base: NDArray[np.float64]) -> list[Fault]:
    """Return a fault if the mount (4, 4) shows that images are in a frame with a body's axes.

    The axes of a body are x ahead, y left, z up (REP 103), those of a camera x right, y down, z
    ahead. A camera that looks at the ceiling has a similar mount, so the fault is a suspicion.
    Poses at which the robot would lie on its side are refused with it.
    """
    _, y, z = camera_from_base[:3, 2]
    if z < _LEAST_Z or abs(y) > _MOST_Y:
        return []
    return [Fault(
        f"by its mount, '{frame_id}' has the axes of a body, x ahead and z up: the camera would "
        f'look up by {math.degrees(math.asin(min(1.0, z))):.0f} degrees; publish images in the '
        'optical frame, or correct tf or base_from_camera', False)]


def load_localizer(node: Node, parameters: RelocalizerParameters,
                   former: FrameLocalizer | None = None) -> FrameLocalizer:
    """Load the map and, if the matching type needs it, CLIP. Keep the CLIP of `former`.

    CliplocError: a file or parameter is invalid, or a download failed.
    """
    if parameters.cache_dir:
        KernelCache.folder = resolve_cache_dir(parameters.cache_dir) / 'kernels'
    options = parameters.options()
    files = map_files(parameters)
    landmark_map, map_hash = load_map(node, files)
    relocalizer = Relocalizer(landmark_map, options)  # errors show before the slow steps
    keyframes = load_keyframes(parameters, landmark_map)
    if not len(landmark_map) and keyframes is None and not landmark_map.tags:
        raise MapError('the map has neither landmarks, tags nor keyframes next to it: rebuild it')
    observer = None
    if options.needs_similarities and len(landmark_map):
        from cliploc_ros.models.clip_encoder import embed_map, load_encoder_for_map
        from cliploc_ros.models.observer import Observer
        from cliploc_ros.models.protocols import ClipOptions
        named = ClipOptions(
            model=parameters.clip_model, pretrained=parameters.clip_pretrained,
            checkpoint_path=parameters.clip_checkpoint_path, cache_dir=parameters.cache_dir)
        asked = (with_encoder(named, parameters.profile), landmark_map, files,
                 parameters.landmark_embeddings)
        if former is not None and former.observer is not None:
            observer = former.observer.with_labels(embed_map(*asked))
        else:
            observer = Observer(*load_encoder_for_map(*asked))
            observer.measure()
    localizer = FrameLocalizer(landmark_map, observer, relocalizer, options, map_hash, keyframes)
    localizer.grids = {part.frame_id: str(Path(file).absolute().parent / part.nav2_map)
                       for (part, *_), file in zip(parts_of(landmark_map), files, strict=False)
                       if part.nav2_map}
    return localizer


def layer_paths(parameters: RelocalizerParameters) -> list[Path]:
    """Return the paths of keyframes_file, or next to the maps; none if there is no layer."""
    named = parameters.keyframes_file
    if named != NEXT_TO_MAP:
        return [Path(named)] if named else []
    paths = [*map(layer_path, map_files(parameters))]
    return paths if any(path.exists() for path in paths) else []


def load_keyframes(parameters: RelocalizerParameters, landmark_map: LandmarkMap
                   ) -> Keyframes | None:
    """Load the layers of layer_paths; None if there is no layer or one is invalid.

    If a layer is invalid or its features cannot be computed here, the error is logged, and the
    relocalizer uses the landmarks only.
    """
    paths = layer_paths(parameters)
    if not paths:
        return None
    from cliploc_ros.models.xfeat import feature_kinds
    try:
        layer = load_layers(paths, landmark_map, feature_kinds(parameters.cache_dir))
        return Keyframes(KeyframeLocalizer(layer), *(', '.join(map(str, texts)) for texts in (
            paths, map(layer_hash, paths))))
    except (MapError, ModelError) as error:
        logger.error('localizing without keyframes: %s', error)
        return None


def load_map(node: Node, files: Sequence[str]) -> tuple[LandmarkMap, str]:
    """Load the map from files, or without files, from the node's parameters; also return its hash.

    The hash is the beginning of the output of `cat FILE... | sha256sum`. For a map in parameters
    it is the hash of its landmarks.

    MapError: the map is invalid, and the message names the source, the landmark and the field; or
    a file changes while it is read.
    """
    if files:
        before = _hash_of(files)
        landmark_map = join_maps([LandmarkMap.from_file(file) for file in files], files)
        if before != _hash_of(files):
            raise MapError(f'{", ".join(files)}: changed while it was read: reload the map')
        return landmark_map, before
    parameters = node.get_parameters_by_prefix('map')
    if not parameters:
        raise MapError('no map: set map_file, or load a map with --params-file')
    tree: dict[str, Any] = {}
    for name, parameter in parameters.items():
        *path, last = name.split('.')
        branch = tree
        for key in path:
            branch = branch.setdefault(key, {})
            if not isinstance(branch, dict):
                raise MapError(f"parameters: map.{name}: '{key}' has both a value and fields")
        branch[last] = parameter.value
    landmark_map = LandmarkMap.from_mapping(tree, 'parameters')
    content = b''.join([
        repr((landmark_map.frame_id, landmark_map.landmark_ids, landmark_map.labels,
              landmark_map.class_ids)).encode(),
        landmark_map.centers.tobytes(), landmark_map.semi_axes.tobytes(),
        landmark_map.quats_xyzw.tobytes()])
    return landmark_map, hashlib.sha256(content).hexdigest()[:_DIGITS]


def _hash_of(files: Sequence[str]) -> str:
    """Return the hash of files; empty if one cannot be read, which from_file reports."""
    try:
        return hashlib.sha256(b''.join(map(read_file, files))).hexdigest()[:_DIGITS]
    except OSError:
        return ''
