# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a frame to a relocalization: the map and the network that stay loaded between requests."""

import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.acceptance.depth_check import DepthScale
from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import Fault, check_faults
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.kernels.compiled import KERNEL_FOLDERS
from cliploc_ros.core.keyframes.layer import (
    KeyframeLayer,
    layer_hash,
    layer_path,
    load_layer_of_map,
)
from cliploc_ros.core.keyframes.localization import (
    ImageRecognizer,
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.localizer import (
    BATCH,
    Crops,
    Localizer,
    by_classes,
    can_do_without_crops,
    informative_first,
)
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import Similarities, split_similarities
from cliploc_ros.core.observation import Detections, Observation, Region
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization, in_its_map
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.watch import Watch, WatchReport
from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.messages import (
    camera_from_msg,
    depths_from_msg,
    detections_from_msg,
    image_from_msg,
    parse_class_map,
)
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.observer import ObservedCrops, Observer
from cliploc_ros.models.profiles import with_encoder
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.frame_faults import faults_of_axes, faults_of_frame
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState
from cliploc_ros.ros.map_parameters import load_hashed_map, map_files, path_of
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.outputs.debug_image import SeenImage
from cliploc_ros.ros.parameters import RelocalizerParameters

logger = logging.getLogger(__name__)

# Time that a request needs after its last crops [s]: for a search, which may take most of a fifth
# of the time that is left, and for the answer. Guesses.
_SEARCHES, _MOST_SHARE, _ANSWER_S = 2.0, 0.2, 0.1
#: Value of keyframes_file for the layer next to the map, if there is one.
NEXT_TO_MAP = 'auto'
# With less time left, the objects' answer stands: extracting features cannot be stopped.
_LEAST_S = 0.5


class Keyframes:
    """A layer, and where it is from.

    Parameters
    ----------
    file, file_hash : str
        Where the layer is from, for the diagnostics.
    """

    def __init__(self, localizer: KeyframeLocalizer, file: str = '', file_hash: str = '') -> None:
        self.file, self.file_hash = file, file_hash
        self._localizer = localizer
        self._notes: set[str] = set()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._localizer.layer)

    @property
    def layer(self) -> KeyframeLayer:
        """Return the layer."""
        return self._localizer.layer

    def recognizer(self, image_rgb: NDArray[np.uint8], camera: Camera, deadline: float,
                   times: StageTimes) -> ImageRecognizer | None:
        """Return the keyframe search of an image; None where too little time is left.

        Parameters
        ----------
        image_rgb : ndarray (h, w, 3) uint8
        deadline : float
            When the request ends (monotonic clock) [s].
        times : StageTimes
            Of this image.
        """
        if deadline - time.monotonic() < _LEAST_S:
            return None
        note = self._localizer.layer.camera_note(camera)
        if note and note not in self._notes:
            self._notes.add(note)
            logger.warning('%s', note)
        return ImageRecognizer(self._localizer, partial(query_features, image_rgb), camera,
                               deadline, times.begin)


class Localized(NamedTuple):
    """The result of one frame."""

    #: In the coordinate frame of the map.
    found: Relocalization
    #: Of several maps, the one of the best pose.
    landmark_map: LandmarkMap
    #: With the crops that were compared, and their similarities to this map.
    seen: SeenImage
    #: Number of crops that were compared with labels.
    compared: int
    #: Whether there was no time for the other crops, which could have helped.
    is_cut: bool
    #: Covariance (6, 6) for a filter that fuses all accepted poses: in continuous mode, that of
    #: the new information, see cliploc_ros.core.localizer.
    for_filter: NDArray[np.float64] | None
    cameras: int  #: Number of cameras whose frames of this instant were used
    left_out: tuple[str, ...]  #: Names of those that had none, or of another run of odometry
    cameras_before: CameraCheck  #: What looks before this frame said of the cameras


class FrameLocalizer:
    """A map and, unless only classes are matched, an observer for its labels and images.

    Parameters
    ----------
    relocalizer : Relocalizer
        Of the map, with these options.
    device : str
        Where the observer's network runs.
    map_hash : str
        See cliploc_ros.ros.map_parameters.
    keyframes : Keyframes, optional
        The layer of keyframes of the map.
    """

    def __init__(self, landmark_map: LandmarkMap, observer: Observer | None,
                 relocalizer: Relocalizer, options: RelocalizerOptions, device: str,
                 map_hash: str, keyframes: Keyframes | None = None) -> None:
        self.device = device
        self.map_hash = map_hash
        self._keyframes = keyframes
        self._map = landmark_map
        self._observer = observer
        self._options = options
        self._localizer = Localizer(relocalizer)
        self._watch = Watch(relocalizer)
        self._notes: set[str] = set()
        self._detector = DetectorCheck(landmark_map, options.matching != 'clip')
        self._faults: dict[str, list[Fault]] = {}  # of the newest frame of each camera
        relocalizer.warm_up()

    @property
    def landmark_map(self) -> LandmarkMap:
        """Return the map, or all maps as one."""
        return self._map

    @property
    def keyframes(self) -> Keyframes | None:
        """Return the layer of keyframes; None without one."""
        return self._keyframes

    @property
    def frame_ids(self) -> list[str]:
        """Return the coordinate frames of the maps."""
        return [part.landmark_map.frame_id for part in parts_of(self._map)]

    @property
    def depth_scale(self) -> DepthScale:
        """Return what accepted poses say of the scale of depth."""
        return self._localizer.depth_scale

    @property
    def faults(self) -> list[Fault]:
        """Return what is wrong with the newest frames, their cameras and their detector."""
        return [*(fault._replace(text=f'{name}: {fault.text}' if name else fault.text)
                  for name, faults in self._faults.copy().items() for fault in faults),
                *(fault._replace(text=f'the detector: {fault.text}')
                  for fault in self._detector.faults)]

    @property
    def cameras(self) -> CameraCheck:
        """Return what looks say of the cameras and their boxes."""
        return self._localizer.cameras

    @property
    def description(self) -> str:
        """Return what is loaded, in a line."""
        frames = [f"'{frame_id}'" for frame_id in self.frame_ids]
        where = f'frame {frames[0]}' if len(frames) == 1 else \
            f'{len(frames)} maps, frames {", ".join(frames)}'
        keyframes = '' if self._keyframes is None else f'{len(self._keyframes)} keyframes, '
        return (f'{len(self._map)} landmarks in {where}, {keyframes}'
                f'matching {self._options.matching}, algorithm {self._options.algorithm}')

    def reloaded(self, node: Node, parameters: RelocalizerParameters) -> 'FrameLocalizer':
        """Return a localizer for the map as it is now; the encoder stays the same.

        CliplocError: names what to fix in the map; this localizer stays as it was.
        """
        options = parameters.options()
        files = map_files(parameters)
        landmark_map, map_hash = load_hashed_map(node, files)
        relocalizer = Relocalizer(landmark_map, options)
        observer = self._observer
        if observer is not None:
            from cliploc_ros.models.map_rows import embed_map
            observer = observer.with_labels(embed_map(
                clip_options_of(parameters), landmark_map, files, parameters.landmark_embeddings))
        return FrameLocalizer(landmark_map, observer, relocalizer, options, self.device, map_hash,
                              load_keyframes(parameters, landmark_map))

    def localize(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
                 times: StageTimes, deadline: float = math.inf,
                 beside: Sequence[tuple[Frame, RobotState]] = (), region: Region | None = None
                 ) -> Localized:
        """Find where the camera was, with a frame and those that odometry links to it.

        `parameters` are as they are now, `state` is that at the stamp of the frame, `beside` are
        frames of other cameras at this instant, `region` is where the robot probably is. No crops
        are compared after `deadline` (monotonic clock) [s].

        CliplocError: names what to fix in the frame or in the parameters.
        """
        times.begin('decoding')
        options = parameters.options()
        localizer = self._localizer_for(options)
        # without odometry the robot itself is what links its cameras
        run = None if state.place is None else state.place.run
        image, observation = self._observed(frame, parameters, state,
                                            run is not None or not frame.camera)
        observation = replace(observation, region=region)
        linked = [(one, its) for one, its in beside
                  if run == (None if its.place is None else its.place.run)]
        others = [
            self._known_crops(*self._observed(one, parameters, its, run is not None), options)
            for one, its in linked]
        names = [one.camera for one, _ in linked]
        left_out = (*frame.left_out, *(one.camera for one, _ in beside if one.camera not in names))
        camera, detections = observation.camera, observation.detections
        crops, observation = self._crops(image, observation, options, times, deadline)
        recognizer = None if self._keyframes is None else self._keyframes.recognizer(
            image, camera, deadline, times)
        times.begin('search')
        found = localizer.localize(
            observation, run, parameters.fuse_frames, parameters.fuse_window_s, crops, recognizer,
            [replace(one, stamp_ns=observation.stamp_ns) for one in others])
        for name in localizer.cameras.wrong_mounts:
            self._note(f'what {name} sees does not fit the other cameras: check its mount, '
                       'camera_info and image')
        seen = localizer.observation
        assert seen is not None
        compared = int((seen.similarity_rows >= 0).sum())
        frame_id = frame.image.header.frame_id
        if (found.accepted and found.map_from_camera is not None
                and parameters.base_frame not in ('', frame_id)):
            with self._keeping(frame.camera):
                check_faults(faults_of_axes(frame_id, state.camera_from_base,
                                            found.map_from_camera))
        is_cut = not found.accepted and self._observer is not None and compared < len(detections)
        for_filter = localizer.covariance_for_filter(found) \
            if found.accepted and parameters.mode == 'continuous' else found.covariance
        found, landmark_map, seen = _in_its_map(self._explained(found), self._map, seen)
        layer = None if self._keyframes is None else self._keyframes.layer
        return Localized(found, landmark_map, SeenImage(image, seen, layer), compared, is_cut,
                         for_filter, 1 + len(others), left_out, localizer.cameras_before)

    def look(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
             frame_id: str, map_from_camera: NDArray[np.float64]) -> WatchReport:
        """Compare a frame with the localizer's pose of its camera (4, 4) in the map `frame_id`.

        Crops are compared only where that costs nothing. Other arguments as for localize.

        CliplocError: names what to fix in the frame or in the parameters.
        """
        shift = next((part.shift for part in parts_of(self._map)
                      if part.landmark_map.frame_id == frame_id), None)
        if shift is None:
            raise MapError(f"no map is in frame '{frame_id}', but in {', '.join(self.frame_ids)}: "
                           "correct the map's frame_id")
        options = parameters.options()
        self._localizer_for(options)
        image, observation = self._observed(frame, parameters, state, True)
        if self._observer is not None and can_do_without_crops(options):
            observation = self._known_crops(image, observation, options)
        elif self._observer is not None:
            observation = by_classes(observation, len(self._map))
        recognizer = None if self._keyframes is None else self._keyframes.recognizer(
            image, observation.camera, math.inf, StageTimes('keyframes', time.monotonic()))
        pose = map_from_camera.copy()
        pose[:3, 3] += shift
        return self._watch.look(observation, pose, image, recognizer)

    def forget_looks(self) -> None:
        """Have the watch begin again."""
        self._watch.forget()

    def _observed(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
                  by_odometry: bool) -> tuple[NDArray[np.uint8], Observation]:
        """Return the image of a frame, and what was detected in it, without crops."""
        with self._keeping(frame.camera):
            image, camera, given = read_frame(frame, parameters)
            faults = faults_of_frame(frame, camera, parameters, state)
            check_faults(faults)
        self._faults[frame.camera] = faults
        detections = given.usable(camera.width, camera.height, parameters.max_detections)
        self._detector.add(given, detections)
        place, odom_from_camera = state.place, None
        if not by_odometry:
            odom_from_camera = invert_transform(state.camera_from_base)
        elif place is not None:
            odom_from_camera = place.odom_from_camera
        return image, Observation(
            camera, detections, stamp_ns=stamp_ns(frame.image.header.stamp),
            camera_name=frame.camera, up_in_camera=state.up_in_camera,
            depths=self._depths(frame, camera, detections.bboxes_xyxy, state.camera_from_depth),
            odom_from_camera=odom_from_camera, odom_way_m=0.0 if place is None else place.way_m)

    @contextmanager
    def _keeping(self, camera: str) -> Iterator[None]:
        """Keep a CliplocError as a fault of a camera."""
        try:
            yield
        except CliplocError as error:
            self._faults[camera] = [Fault(str(error), True)]
            raise

    def _explained(self, found: Relocalization) -> Relocalization:
        """Return a result whose refusal also names what is wrong with the newest frames."""
        if found.accepted:
            return found
        found = self._detector.explain(found)
        texts = (fault.text for fault in self.faults if not fault.is_certain)
        return replace(found, reason='; '.join([found.reason, *texts]))

    def _known_crops(self, image: NDArray[np.uint8], observation: Observation,
                     options: RelocalizerOptions) -> Observation:
        """Return what another camera sees, with the crops that cost nothing.

        The paper's algorithms compare all crops, however long that takes.
        """
        if self._observer is None:
            return observation
        if not can_do_without_crops(options):
            seen = self._observer.observe(image, observation.camera, observation.detections,
                                          observation.stamp_ns)
            return replace(observation, similarities=seen.similarities)
        crops = self._observer.crops(image, observation.detections.bboxes_xyxy)
        return replace(observation, similarities=crops.compare(crops.known), compared=crops.known)

    def _depths(self, frame: Frame, camera: Camera, bboxes_xyxy: NDArray[np.float64],
                camera_from_depth: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        """Return the depth of each box (n,); None without depth, or where it cannot be used."""
        if frame.depth is None:
            return None
        if self.depth_scale.is_wrong:
            self._note(f'depth is {self.depth_scale.ratio:.2f} times what boxes and map say, and '
                       'is used no more: check its unit, calibration and registration')
            return None
        try:
            return depths_from_msg(frame.depth, frame.image.header.frame_id, camera, bboxes_xyxy,
                                   frame.depth_camera_info, camera_from_depth)
        except CliplocError as error:
            self._note(f'localizing without depth: {error}')
            return None

    def _note(self, text: str) -> None:
        """Log a warning once."""
        if text not in self._notes:
            self._notes.add(text)
            logger.warning('%s', text)

    def _crops(self, image: NDArray[np.uint8], observation: Observation,
               options: RelocalizerOptions, times: StageTimes, deadline: float
               ) -> tuple[Crops | None, Observation]:
        """Return crops that the search compares as it needs them, or a frame with compared crops.

        The paper's algorithms compare all crops, however long that takes.
        """
        observer, boxes = self._observer, observation.detections.bboxes_xyxy
        if observer is None:
            return None, observation
        if not can_do_without_crops(options):
            times.begin('CLIP')
            seen = observer.observe(image, observation.camera, observation.detections,
                                    observation.stamp_ns)
            return None, replace(observation, similarities=seen.similarities)
        end = deadline - _ANSWER_S - min(_SEARCHES * options.time_budget_s,
                                         _MOST_SHARE * (deadline - time.monotonic()))
        if options.crops == 'on_demand':
            crops = observer.crops(image, boxes)

            def compare(rows: NDArray[np.int64]) -> Similarities:
                times.begin('CLIP')
                similarities = crops.compare(rows)
                times.begin('search')
                return similarities

            return Crops(compare, crops.known, lambda: min(
                BATCH, observer.crops_within(end - time.monotonic()))), observation
        times.begin('CLIP')
        every = ObservedCrops(observer, image, boxes, {})
        rows, count = informative_first(self._map, observation), 0
        while count < len(rows) and (room := observer.crops_within(end - time.monotonic())) > 0:
            count += room
            every.compare(rows[:count])
        return None, replace(observation, similarities=every.compare(rows[:count]),
                             compared=rows[:count])

    def _localizer_for(self, options: RelocalizerOptions) -> Localizer:
        """Return the localizer; other options begin a new one, and a new watch."""
        if options != self._options:
            relocalizer = Relocalizer(self._map, options)
            self._localizer, self._watch = Localizer(relocalizer), Watch(relocalizer)
            self._options = options
        return self._localizer


def load_localizer(node: Node, parameters: RelocalizerParameters) -> FrameLocalizer:
    """Load map and, if the matching type asks for it, CLIP.

    CliplocError: names the file, parameter or download to mend.
    """
    if parameters.cache_dir:
        KERNEL_FOLDERS.prefer(resolve_cache_dir(parameters.cache_dir) / 'kernels')
    options = parameters.options()
    files = map_files(parameters)
    landmark_map, map_hash = load_hashed_map(node, files)
    relocalizer = Relocalizer(landmark_map, options)  # before what takes long
    observer, device = None, 'cpu'
    if options.needs_similarities:
        from cliploc_ros.models.map_rows import load_encoder_for_map
        encoder, embeddings = load_encoder_for_map(
            clip_options_of(parameters), landmark_map, files, parameters.landmark_embeddings)
        observer, device = Observer(encoder, embeddings), encoder.device
        observer.measure()
    return FrameLocalizer(landmark_map, observer, relocalizer, options, device, map_hash,
                          load_keyframes(parameters, landmark_map))


def read_frame(frame: Frame, parameters: RelocalizerParameters
               ) -> tuple[NDArray[np.uint8], Camera, Detections]:
    """Return image, camera and all detections of a frame; CliplocError: one is invalid."""
    image = image_from_msg(frame.image)
    height, width = image.shape[:2]
    camera = camera_from_msg(frame.camera_info, (width, height), parameters.rectified)
    return image, camera, detections_from_msg(frame.detections,
                                              parse_class_map(parameters.class_map))


def _in_its_map(found: Relocalization, landmark_map: LandmarkMap, seen: Observation
                ) -> tuple[Relocalization, LandmarkMap, Observation]:
    """Return result, map and observation of the one of several maps that has the best pose."""
    found, own = in_its_map(found, landmark_map)
    parts = parts_of(landmark_map)
    if seen.similarities is None or len(parts) == 1:
        return found, own.landmark_map, seen
    pieces = split_similarities(seen.similarities, [len(part.landmark_map) for part in parts])
    which = [part.first for part in parts].index(own.first)
    return found, own.landmark_map, replace(seen, similarities=pieces[which])


def clip_options_of(parameters: RelocalizerParameters) -> ClipOptions:
    """Return the CLIP that parameters name: that of the profile where they name none."""
    named = ClipOptions(
        model=parameters.clip_model, pretrained=parameters.clip_pretrained,
        checkpoint_path=parameters.clip_checkpoint_path, device=parameters.device,
        cache_dir=parameters.cache_dir, inference=parameters.inference)
    return with_encoder(named, parameters.profile)


def keyframes_path(parameters: RelocalizerParameters) -> Path | None:
    """Return the layer that the parameters name, or the one next to the map; None without one."""
    named, map_file = parameters.keyframes_file, parameters.map_file
    if named != NEXT_TO_MAP:
        return Path(named) if named else None
    path = layer_path(path_of(map_file)) if map_file else None
    return path if path is not None and path.exists() else None


def load_keyframes(parameters: RelocalizerParameters, landmark_map: LandmarkMap
                   ) -> Keyframes | None:
    """Return the layer that the parameters name; None without one, or where it is bad.

    A bad layer is logged with what to do, and the relocalizer goes on with the landmarks.
    """
    path = keyframes_path(parameters)
    if path is None:
        return None
    try:
        layer = load_layer_of_map(path, landmark_map)
        return Keyframes(KeyframeLocalizer(layer), str(path), layer_hash(path))
    except MapError as error:
        logger.error('localizing without keyframes: %s', error)
        return None
