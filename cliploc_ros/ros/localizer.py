# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a frame to a relocalization: the map and the network that stay loaded between requests."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from rclpy.node import Node

from cliploc_ros.cache_folder import resolve_cache_dir
from cliploc_ros.core.kernel_cache import KERNEL_FOLDERS
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.session import Session
from cliploc_ros.messages import camera_from_msg, image_from_msg
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.profiles import with_encoder
from cliploc_ros.ros.conversions import (
    detections_from_msg,
    stamp_ns,
)
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import CameraPlace, RobotState
from cliploc_ros.ros.map_parameters import load_map
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.outputs.debug_image import SeenImage
from cliploc_ros.ros.parameter_tables import parse_class_map, relocalizer_options


class Localized(NamedTuple):
    """The result of one frame, what was seen in it, and how long each stage took."""

    found: Relocalization
    seen: SeenImage
    times: StageTimes


class Localizer:
    """A map and, unless only classes are matched, an observer for its labels and images.

    Parameters
    ----------
    landmark_map : LandmarkMap
    observer : Observer or None
    relocalizer : Relocalizer
        Of the map, with these options.
    options : RelocalizerOptions
    device : str
        Where the observer's network runs.
    """

    def __init__(self, landmark_map: LandmarkMap, observer: Observer | None,
                 relocalizer: Relocalizer, options: RelocalizerOptions, device: str) -> None:
        self.device = device
        self._map = landmark_map
        self._observer = observer
        self._options = options
        self._session = Session(relocalizer)
        relocalizer.warm_up()

    @property
    def landmark_map(self) -> LandmarkMap:
        """Return the map."""
        return self._map

    @property
    def map_frame(self) -> str:
        """Return the coordinate frame of the poses."""
        return self._map.frame_id

    @property
    def description(self) -> str:
        """Return what is loaded, in a line."""
        return (f"{len(self._map)} landmarks in frame '{self._map.frame_id}', "
                f'{self._options.matching}_{self._options.algorithm}')

    def reloaded(self, node: Node, values: Mapping[str, Any]) -> 'Localizer':
        """Return a localizer for the map as it is now; the encoder stays the same.

        Raises
        ------
        CliplocError
            Names what to fix in the map; this localizer stays as it was.
        """
        options = relocalizer_options(values)
        landmark_map = load_map(node, values['map_file'])
        relocalizer = Relocalizer(landmark_map, options)
        observer = self._observer
        if observer is not None:
            from cliploc_ros.models.map_rows import embed_map
            observer = observer.with_labels(embed_map(
                _clip_options(values), landmark_map, values['map_file'],
                values['landmark_embeddings']))
        return Localizer(landmark_map, observer, relocalizer, options, self.device)

    def localize(self, frame: Frame, values: Mapping[str, Any], state: RobotState) -> Localized:
        """Find where the camera was, with a frame and those that odometry links to it.

        Parameters
        ----------
        frame : Frame
        values : mapping
            The relocalizer's parameters, as they are now.
        state : RobotState
            At the stamp of the frame.

        Raises
        ------
        CliplocError
            Names what to fix in the frame or in the parameters.
        """
        times = StageTimes(frame.received_at)
        times.mark('waiting')
        image = image_from_msg(frame.image)
        height, width = image.shape[:2]
        camera = camera_from_msg(frame.camera_info, (width, height), values['rectified'])
        detections = detections_from_msg(
            frame.detections, parse_class_map(values['class_map'])).usable(
                width, height, values['max_detections'])
        times.mark('decoding')
        stamp = stamp_ns(frame.image.header.stamp)
        observation = Observation(camera, detections, stamp_ns=stamp) if self._observer is None \
            else self._observer.observe(image, camera, detections, stamp)
        times.mark('CLIP')
        found = self._relocalize(replace(observation, up_in_camera=state.up_in_camera),
                                 state.place, values)
        times.mark('search')
        return Localized(found, SeenImage(image, observation), times)

    def _relocalize(self, observation: Observation, place: CameraPlace | None,
                    values: Mapping[str, Any]) -> Relocalization:
        """Localize with a frame and those before it that odometry links to it."""
        session = self._session_for(relocalizer_options(values))
        if place is None:
            return session.localize(observation)
        return session.localize(replace(observation, odom_from_camera=place.odom_from_camera),
                                place.run, values['fuse_frames'], values['fuse_window_s'])

    def _session_for(self, options: RelocalizerOptions) -> Session:
        """Return the session; other options begin a new one."""
        if options != self._options:
            self._session, self._options = Session(Relocalizer(self._map, options)), options
        return self._session


def load_localizer(node: Node, values: Mapping[str, Any]) -> Localizer:
    """Load map and, if the matching type asks for it, CLIP.

    Raises
    ------
    CliplocError
        Names the file, parameter or download to mend.
    """
    if values['cache_dir']:
        KERNEL_FOLDERS.prefer(resolve_cache_dir(values['cache_dir']) / 'kernels')
    options = relocalizer_options(values)
    landmark_map = load_map(node, values['map_file'])
    relocalizer = Relocalizer(landmark_map, options)  # before what takes long
    observer, device = None, 'cpu'
    if options.needs_similarities:
        from cliploc_ros.models.map_rows import load_encoder_for_map
        encoder, embeddings = load_encoder_for_map(
            _clip_options(values), landmark_map, values['map_file'],
            values['landmark_embeddings'])
        observer, device = Observer(encoder, embeddings), encoder.device
    return Localizer(landmark_map, observer, relocalizer, options, device)


def _clip_options(values: Mapping[str, Any]) -> ClipOptions:
    named = ClipOptions(model=values['clip_model'], pretrained=values['clip_pretrained'],
                        checkpoint_path=values['clip_checkpoint_path'], device=values['device'],
                        cache_dir=values['cache_dir'], inference=values['inference'])
    return with_encoder(named, values['profile'])
