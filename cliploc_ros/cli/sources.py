# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read the recording that the command line names, see cli.options."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.cli.options import FOLDERS, check_folder_options, folder_of, read_layer
from cliploc_ros.command import positive
from cliploc_ros.core.geometry.depth import DepthCamera
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError, DatasetError, MappingError, OptionsError
from cliploc_ros.models import protocols
from cliploc_ros.models.files import digest_file
from cliploc_ros.offline.datasets import bag_frames, bag_poses, frames
from cliploc_ros.offline.datasets.folders import find_layout, read_folder, rgbd_frames
from cliploc_ros.offline.datasets.images import Images, images_of_recording, open_images
from cliploc_ros.offline.datasets.map_recording import MapRecording, load_recording
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.datasets.parsing import naming
from cliploc_ros.offline.datasets.poses import Poses, mount_from_numbers
from cliploc_ros.offline.datasets.tum import read_tum_trajectory
from cliploc_ros.offline.mapping.posed_detections import PosedDetections, join_detections
from cliploc_ros.offline.recording import recorder
from cliploc_ros.offline.recording.joining import Placing, add_layer
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.units import NS_PER_S

# Options that change how the frames of a recording are read.
_READING = ('pose_topic', 'map_frame', 'camera_frame', 'tf', 'trajectory', 'mount', 'max_gap',
            'stamp_tolerance', 'image', 'camera_info', 'rectified', 'depth', 'depth_unit',
            'depth_intrinsics', 'depth_baseline', 'intrinsics', 'cameras')
# Options that define the poses of a folder.
_PLACING = ('axes', 'scale', 'known_distance', 'level')

# Recordings of one map count as this far apart in time, or more [s].
_APART_S = 3600.0


def detector_options(options: argparse.Namespace, **more: Any) -> protocols.DetectorOptions:
    """Return the detector that the command line names."""
    words = options.detector_vocabulary
    prompts = () if not words else (
        protocols.prompts_of_map(LandmarkMap.from_file(words), words) if words.endswith('.yaml')
        else protocols.prompts_of_names(words))
    return protocols.with_detector(protocols.DetectorOptions(
        model=options.model, prompts=prompts, text_model=options.text_model, **more),
        options.profile)


def clip_options(options: argparse.Namespace) -> protocols.ClipOptions:
    """Return the CLIP that the command line names."""
    return protocols.with_encoder(protocols.ClipOptions(
        model=options.clip_model, pretrained=options.clip_pretrained), options.profile)


def metres_of(text: str, option: str) -> float:
    """Return the length that an option gives; OptionsError: it is not a length."""
    try:
        return positive(text)
    except (ValueError, argparse.ArgumentTypeError):
        raise OptionsError(f'{option}: {text} is not a length above 0 m') from None


def find_topics(options: argparse.Namespace, bag: Path | None) -> None:
    """Set the topics of image and camera_info that the command line does not name.

    DatasetError: the bag has no such topic, or several.
    """
    if getattr(options, 'intrinsics', None) is not None:  # no camera_info is needed
        options.camera_info = options.camera_info or bag_frames.BagTopics.camera_info
    open_topics = [name for name in ('image', 'camera_info') if getattr(options, name) is None]
    if bag is None or options.cameras != ['']:
        options.image = options.image or bag_frames.BagTopics.image
        options.camera_info = options.camera_info or bag_frames.BagTopics.camera_info
    elif open_topics:
        options.image, options.camera_info = bag_frames.find_topics(bag, options.image,
                                                                    options.camera_info)
        print(f'{bag}: {" and ".join(getattr(options, name) for name in open_topics)}', flush=True)


def recorded(options: argparse.Namespace, built_from: MapRecording | None
             ) -> tuple[PosedDetections | None, Images | None]:
    """Return the boxes and images that the command line names, by default those of a map.

    CliplocError: they cannot be used. Images of the map that cannot be read are left out.
    """
    detections, images = None, None
    if options.observations is not None:
        detections = load_observations(options.observations)
    elif built_from is not None:
        detections = built_from.load()
    known = [''] if detections is None else list(detections.camera_names)
    cameras = known if options.cameras == [''] else list(dict.fromkeys(options.cameras))
    if unknown := [name for name in cameras if name not in known]:
        raise OptionsError(f"--cameras: the observations have no camera '{unknown[0]}'; they have "
                           f'{", ".join(filter(None, known)) or "one without a name"}')
    if (path := options.images) is not None:
        is_bag = path.exists() and find_layout(path) is None
        find_topics(options, path if is_bag and cameras == [''] else None)
        images = open_images(path, bag_frames.BagTopics(
            options.image, options.camera_info, options.rectified), cameras)
    elif built_from is not None and detections is not None:
        try:
            images = images_of_recording(built_from, cameras)
        except CliplocError as error:
            print(f'without images: {error}', flush=True)
    return detections, images


def read_source(options: argparse.Namespace) -> tuple[PosedDetections, Path, frames.Frames | None]:
    """Return the observations of a source, their file, and its images if there are any.

    CliplocError: the source, the networks or the options cannot be used.
    """
    if options.bag is None and (options.odometry_topic or options.odometry_frame):
        raise OptionsError('--odometry-topic and --odometry-frame are for --bag')
    _mounts(options)
    check_folder_options(options)
    find_topics(options, options.bag)
    file, images = options.observations, None
    if file is None:
        of_cameras = read_cameras(options)
        images = of_cameras[''] if '' in of_cameras else frames.join_frames(of_cameras)
        print(''.join(f'{note}\n' for note in images.notes), end='', flush=True)
        recording = recording_options(options, recorder.KeyframeOptions(*options.keyframes))
        file = options.record_to or recorder.observation_file(images, recording)
        found = recorder.record_once(images, recording, file, _odometry(options))
    else:
        found = load_observations(file)
    if found.without_pose:
        print(f'no pose: {found.without_pose} of {found.images} images', flush=True)
    return found, file, images


def recording_options(options: argparse.Namespace, keyframes: recorder.KeyframeOptions,
                      *more: object) -> recorder.RecordingOptions:
    """Return the options for running detector and CLIP on the images that the command line names.

    They include a text with all options that affect reading, and with `more` from the program.
    Each text has its own observation file.
    """
    reading = [*(str(getattr(options, name)) for name in _READING), *map(str, more),
               options.trajectory and digest_file(options.trajectory)]
    conf = {'conf': options.conf} if 'conf' in options else {}
    return recorder.RecordingOptions(
        detector_options(options, **conf), clip_options(options) if options.clip else None,
        keyframes, repr(reading), options.workers or 1, options.scheduler)


def recording_of(options: argparse.Namespace, file: Path, scale: float,
                 rotation: NDArray[np.float64]) -> MapRecording:
    """Return the recording of a map, whose poses are those of a file, scaled and rotated."""
    folder = folder_of(options)
    source, layout = folder or (options.bag, '')
    topics = {} if options.bag is None else {
        name: getattr(options, name) for name in ('image', 'camera_info', 'rectified')}
    placing = {} if folder is None else {
        name: getattr(options, name) for name in _PLACING if getattr(options, name)}
    # --rgbd detects its layout
    return MapRecording(file, source, layout='' if layout == 'rgbd' else layout,
                        intrinsics=options.intrinsics, images=options.images, placing=placing,
                        scale=scale, rotation=rotation.tolist(), **topics)


def read_cameras_of_map(options: argparse.Namespace, map_file: Path) -> dict[str, frames.Frames]:
    """Return the images of the source by camera, with their poses in a map, see read_cameras.

    A map that was levelled or scaled has different poses than its recording. If the source is this
    recording, its poses are transformed as they were for the map.
    """
    built_from = load_recording(map_file)
    if built_from is None or built_from.source is None or (
            built_from.source.resolve() != source_of(options).resolve()):
        if options.bag is not None and built_from is not None and built_from.is_moved:
            raise OptionsError(f'{map_file}: was levelled or scaled by build_map, the poses of '
                               '--bag were not; give the recording that the map was built from')
        return read_cameras(options, gap_s=0.0)
    if not any(getattr(options, name) for name in _PLACING):
        for name, value in built_from.placing.items():
            setattr(options, name, value)
    is_scaled = built_from.scale != 1.0  # by --object-size
    images = read_cameras(options, gap_s=0.0, any_unit=is_scaled)
    if not built_from.is_moved:
        return images
    return {name: frames.move_frames(own, built_from.scale, np.array(built_from.rotation))
            for name, own in images.items()}


def each_recording(options: argparse.Namespace) -> list[argparse.Namespace]:
    """Return the options of each recording that the command line names: bags, then folders.

    Options that level or scale poses count for the first one. OptionsError: there is none.
    """
    kinds = ('bag', *FOLDERS, 'observations')
    found = [argparse.Namespace(**vars(options) | dict.fromkeys(kinds) | {name: path})
             for name in kinds for path in getattr(options, name) or ()]
    # further recordings are placed in the map, so that any unit will do
    for own in found[0 if options.add else 1:]:
        vars(own).update(level=False, known_distance=None, record_to=None, object_size=())
    if not found:
        raise OptionsError('give a recording: --bag, --folder, --observations or another')
    return found


def read_recordings(options: argparse.Namespace, recordings: Sequence[argparse.Namespace],
                    place: Callable[..., Any], wanted: LayerOptions | None) -> tuple[
                        PosedDetections, MapRecording, frames.Frames | None, KeyframeLayer | None]:
    """Read the recordings of a map; with --add, after those of that map.

    `place` levels and scales the first one. Return detections, what the map names as its
    recording, and either the images of a single recording, or the keyframes of several, see
    add_layer.
    """
    if options.add is not None:
        if (recording := load_recording(options.add)) is None:
            raise OptionsError(f'--add {options.add}: its recording is missing: give all again')
        if recording.is_update:
            raise OptionsError(f'--add {options.add}: only boxes of its last update are known: '
                               'build it of all recordings, and update it afterwards')
        layer = read_layer([options.add], LandmarkMap.from_file(options.add), None)
    else:
        first, *recordings = recordings
        detections, file, images = read_source(first)
        detections, scale, rotation = place(detections, first, bool(images and images.of_tf))
        recording, layer = recording_of(first, file, scale, rotation), None
        images = images and frames.move_frames(images, scale, rotation)
        if not recordings:
            return (detections, replace(recording, is_update=options.update is not None), images,
                    None)
        if images is not None and wanted is not None:
            layer = build_layer(images, LandmarkMap.empty(options.frame_id), wanted)
    parts, others = [recording.load() if options.add else detections], [*recording.others]
    cameras = recording.cameras or parts[0].camera_names
    for own in recordings:
        (seen, file, images), placing = read_source(own), Placing()
        with naming(source_of(own), MappingError):
            if layer is not None and images is not None and wanted is not None:
                layer, placing, note = add_layer(
                    layer, build_layer(images, LandmarkMap.empty(layer.frame_id), wanted),
                    not images.is_metric, options.same_frame, options.keyframes_per_cell)
                print(f'{source_of(own)}: {note}', flush=True)
            elif not options.same_frame:
                raise MappingError('no keyframes place it in the map: give `same_frame` if its '
                                   'poses are in the frame of the map')
        end_s = max(part.stamps_s[-1] for part in parts)
        later_s = max(0.0, float(end_s + _APART_S - seen.stamps_s[0]))
        parts.append(replace(seen.moved(*placing), stamps_s=seen.stamps_s + later_s,
                             stamps_ns=None))
        others.append(replace(recording_of(own, file, placing.scale, placing.rotation),
                              later_s=later_s, cameras=seen.camera_names))
    return (join_detections(parts), replace(recording, cameras=cameras, others=tuple(others)),
            None, layer)


def source_of(options: argparse.Namespace) -> Path:
    """Return the folder or file that the command line names."""
    found = folder_of(options)
    return found[0] if found is not None else Path(options.bag or options.observations)


def read_cameras(options: argparse.Namespace, gap_s: float | None = None, *,
                 any_unit: bool = False) -> dict[str, frames.Frames]:
    """Return the images of the source with their poses, by camera name, '' for a single camera.

    The poses of a topic or a folder are interpolated over gaps of `gap_s` [s]; None: of --max-gap,
    like those of tf. Not for --observations. CliplocError: the source or the options cannot be
    used.
    """
    mounts = _mounts(options)
    gap_ns = round((options.max_gap if gap_s is None else gap_s) * NS_PER_S)
    if (found := folder_of(options)) is None:
        return {name: _frames_of(options, name, mount, gap_ns) for name, mount in mounts.items()}
    if options.pose_topic or options.map_frame or options.depth:
        raise OptionsError('--pose-topic, --map-frame and --depth are for --bag')
    distance = None
    if options.known_distance is not None:
        first, second, metres = options.known_distance
        distance = first, second, metres_of(metres, '--known-distance')
        if options.scale is not None:
            raise OptionsError('give --scale or --known-distance, not both')
    path, key = found
    folder = frames.FolderOptions(
        options.intrinsics, options.trajectory and read_tum_trajectory(options.trajectory), gap_ns,
        mounts[''], _depth_format(options), key, options.images, options.axes, options.scale,
        distance, any_unit or getattr(options, 'object_size', None) is not None, options.level,
        round(options.stamp_tolerance * NS_PER_S))
    return {'': rgbd_frames(path, folder) if key == 'rgbd' else read_folder(path, folder)}


def _mounts(options: argparse.Namespace) -> dict[str, NDArray[np.float64] | None]:
    """Return the mount (4, 4) of each camera by its name; None if it is not given.

    The name is '' for a single camera. OptionsError: a name is given twice, the source is not a
    bag, or the numbers of --mount are not those of the cameras.
    """
    names, numbers = options.cameras, options.mount
    if len(set(names)) < len(names):
        raise OptionsError(f'--cameras {" ".join(names)}: names a camera twice')
    if names != [''] and options.bag is None:
        raise OptionsError('--cameras is for --bag')
    if numbers is None:
        return dict.fromkeys(names)
    if len(numbers) != 7 * len(names):
        raise OptionsError(f'--mount has {len(numbers)} numbers, expected 7 for each of '
                           f'{len(names)} camera{"s" if len(names) > 1 else ""}')
    return {name: mount_from_numbers(numbers[7 * row:7 * row + 7])
            for row, name in enumerate(names)}


def _frames_of(options: argparse.Namespace, name: str, mount: NDArray[np.float64] | None,
               gap_ns: int) -> frames.Frames:
    """Return the images of one camera of a bag; its name is '' if it is the only one."""
    topics = bag_frames.BagTopics(options.image, options.camera_info, options.rectified,
                                  options.depth or '', options.intrinsics,
                                  round(options.stamp_tolerance * NS_PER_S), options.tf)
    several = len(options.cameras) > 1
    given = [name for name, value in (
        ('--pose-topic', options.pose_topic), ('--map-frame', options.map_frame),
        ('--trajectory', options.trajectory)) if value is not None]
    for is_wrong, text in (
            (len(given) > 1, f'{", ".join(given)}: give only one source of poses'),
            (not given and mount is not None,
             '--mount is for --pose-topic and --trajectory: name one of them'),
            (options.trajectory and mount is None and several,
             '--trajectory of several cameras: give the --mount of each'),
            (options.map_frame and mount is not None,
             '--mount is not for --map-frame: tf has the mount'),
            (options.map_frame and options.camera_frame and several,
             '--camera-frame is for one camera: with several, the images name the frames')):
        if is_wrong:
            raise OptionsError(text)
    source = _pose_source(options, name, mount, gap_ns, options.pose_topic, options.map_frame)
    if options.trajectory is not None:
        source = replace(source, trajectory=replace(
            read_tum_trajectory(options.trajectory), max_gap_ns=source.max_gap_ns,
            body_from_camera=mount, tolerance_ns=topics.tolerance_ns))
    try:
        return bag_frames.bag_frames(options.bag, topics.of_camera(name), source,
                                     _depth_format(options))
    except DatasetError as error:
        if not name:
            raise
        raise DatasetError(f"camera '{name}': {error}") from error


def _pose_source(options: argparse.Namespace, camera: str, mount: NDArray[np.float64] | None,
                 gap_ns: int, topic: str | None, map_frame: str | None) -> bag_poses.PoseSource:
    """Return the source of a camera's poses; without a mount, a topic is in its namespace."""
    if topic is not None and mount is None:
        topic = bag_frames.topic_of(camera, topic)
    return bag_poses.PoseSource(
        topic, map_frame, None, options.camera_frame, options.tf,
        round(options.max_gap * NS_PER_S), gap_ns, mount,
        round(options.stamp_tolerance * NS_PER_S),
        bag_frames.topic_of(camera, bag_poses.GROUND_TRUTH))


def _odometry(options: argparse.Namespace) -> dict[str, Poses] | None:
    """Return the odometry of each camera of a bag, by name; None if no option names any."""
    topic = options.odometry_topic
    if options.odometry_frame is None and topic is None:
        return None
    if topic is not None and options.map_frame is not None:
        raise OptionsError('--odometry-topic needs a --mount, which is not for --map-frame: give '
                           '--odometry-frame')
    return {name: bag_poses.bag_odometry(
        options.bag, bag_frames.topic_of(name, options.image), _pose_source(
            options, name, mount, round(options.max_gap * NS_PER_S), topic,
            options.odometry_frame), '' if options.intrinsics else bag_frames.topic_of(
                name, options.camera_info)) for name, mount in _mounts(options).items()}


def _depth_format(options: argparse.Namespace) -> frames.DepthFormat:
    camera = None
    if options.depth_intrinsics is not None:
        baseline = np.array(options.depth_baseline or (0.0, 0.0, 0.0))
        fx, fy, cx, cy = options.depth_intrinsics
        camera = DepthCamera(fx, fy, cx, cy, make_transform(np.eye(3), baseline))
    elif options.depth_baseline is not None:
        raise OptionsError('--depth-baseline needs --depth-intrinsics')
    return frames.DepthFormat(options.depth_unit, camera)
