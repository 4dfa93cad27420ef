# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a frame to a relocalization: the map and the network that stay loaded between requests."""

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.acceptance.depth_check import DepthScale
from cliploc_ros.core.geometry.camera_faults import Fault
from cliploc_ros.core.kernels.compiled import KERNEL_FOLDERS
from cliploc_ros.core.keyframes.layer import (
    KeyframeLayer,
    layer_hash,
    layer_path,
    load_layer_of_map,
)
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer, by_classes, can_do_without_crops
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import split_similarities
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer, in_its_map
from cliploc_ros.core.watch.watch import Watch, WatchReport
from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.profiles import with_encoder
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.instants import Instants
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.map_parameters import load_hashed_map, map_files, path_of
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.outputs.debug_image import SeenImage
from cliploc_ros.ros.parameters import RelocalizerParameters

logger = logging.getLogger(__name__)

#: Value of keyframes_file for the layer next to the map, if there is one.
NEXT_TO_MAP = 'auto'


class Keyframes(NamedTuple):
    """The keyframes of a map, and where they are from, for the diagnostics."""

    localizer: KeyframeLocalizer
    file: str = ''
    file_hash: str = ''

    @property
    def layer(self) -> KeyframeLayer:
        """Return the layer."""
        return self.localizer.layer


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
    left_out: tuple[str, ...]  #: Names of cameras without a frame, or of another run of odometry
    query: Query  #: With it the same answer comes again


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
        self._instants = Instants(landmark_map, options.matching != 'clip')
        self._begin(relocalizer)
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
        return self._instants.faults

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
        keyframes = '' if self._keyframes is None else f'{len(self._keyframes.layer)} keyframes, '
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

    def localize(self, frame: Frame, parameters: RelocalizerParameters, known: KnownBefore,
                 times: StageTimes, deadline: float = math.inf) -> Localized:
        """Find where the camera was, with a frame and those that odometry links to it.

        `parameters` are as they are now, `known` is what is known besides. No crops are compared
        after `deadline` (monotonic clock) [s].

        CliplocError: names what to fix in the frame or in the parameters.
        """
        times.begin('decoding')
        query = self._instants.query(frame, parameters, known)
        found = self.answer(query, parameters.options(), times, deadline)
        localizer = self._localizer
        assert localizer.query is not None
        query, seen = localizer.query, localizer.query.newest
        if (found.accepted and found.map_from_camera is not None
                and parameters.base_frame not in ('', frame.image.header.frame_id)):
            self._instants.check_axes(frame, known.state, found.map_from_camera)
        compared = int((seen.similarity_rows >= 0).sum())
        is_cut = not found.accepted and self._observer is not None \
            and compared < len(seen.detections)
        for_filter = localizer.covariance_for_filter(found) \
            if found.accepted and parameters.mode == 'continuous' else found.covariance
        found, landmark_map, seen = _in_its_map(self._instants.explained(found), self._map, seen)
        names = [one.camera_name for one in query.frames]
        layer = None if self._keyframes is None else self._keyframes.layer
        return Localized(
            found, landmark_map, SeenImage(query.images[-1], seen, layer), compared, is_cut,
            for_filter, (*frame.left_out, *(one.camera for one, _ in known.beside
                                            if one.camera not in names)), query)

    def answer(self, query: Query, options: RelocalizerOptions, times: StageTimes,
               deadline: float = math.inf) -> Relocalization:
        """Answer a query with options as they are now; see localize."""
        localizer = self._localizer_for(options)
        if self._keyframes is not None:
            self._instants.note(self._keyframes.layer.camera_note(query.newest.camera))
        times.begin('search')
        found = localizer.answer(query, self._observer, deadline, times.begin)
        for name in localizer.cameras.wrong_mounts:
            self._instants.note(f'what {name} sees does not fit the other cameras: check its '
                                'mount, camera_info and image')
        if localizer.depth_scale.is_wrong:
            self._instants.note(
                f'depth is {localizer.depth_scale.ratio:.2f} times what boxes and map say, and '
                'is used no more: check its unit, calibration and registration')
        return found

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
        localizer = self._localizer_for(options)
        query = self._instants.query(frame, parameters, KnownBefore(state))
        observation = localizer.with_free_crops(query, 0, self._observer) \
            if can_do_without_crops(options) else by_classes(query.newest, len(self._map))
        pose = map_from_camera.copy()
        pose[:3, 3] += shift
        return self._watch.look(observation, pose, query.images[-1], localizer.recognizer(query))

    def forget_looks(self) -> None:
        """Have the watch begin again."""
        self._watch.forget()

    def _begin(self, relocalizer: Relocalizer) -> None:
        """Answer and watch with a relocalizer from now on."""
        self._localizer = Localizer(
            relocalizer, None if self._keyframes is None else self._keyframes.localizer)
        self._watch = Watch(relocalizer)

    def _localizer_for(self, options: RelocalizerOptions) -> Localizer:
        """Return the localizer; other options begin a new one, and a new watch."""
        if options != self._options:
            self._begin(Relocalizer(self._map, options))
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
