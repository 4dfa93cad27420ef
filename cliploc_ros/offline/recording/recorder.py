# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Record observations once, in an observation file in the cache folder.

The file is named after a hash of all that determines its content: source, networks, keyframes.
Moved and copied recordings have the same name. The outputs of the networks are also kept next to
it, in a file named after a hash of images and networks. A run takes them from there, whatever the
poses, keyframes and depth are, and also after an interrupted run.
"""

import base64
import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.core.detector_check import in_words
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import PLAUSIBLE_DEPTH_M, depths_of_boxes
from cliploc_ros.errors import DatasetError
from cliploc_ros.files.log import Log
from cliploc_ros.files.parallel import run_tasks
from cliploc_ros.files.storage import make_folder, parse_json, unfinished
from cliploc_ros.models.files import fingerprint_file
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.onnx_detector import GREY, is_grey, load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from cliploc_ros.offline.datasets.bags import MOST_LEFT_OUT
from cliploc_ros.offline.datasets.frames import Frames, RawFrame
from cliploc_ros.offline.datasets.map_recording import recordings_folder
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.datasets.poses import Poses
from cliploc_ros.offline.mapping.posed_detections import PosedDetections, group_cameras
from cliploc_ros.offline.mapping.views import KeyframeFilter, KeyframeOptions
from cliploc_ros.offline.recording.networks import SeenFrame, load_networks
from cliploc_ros.units import NS_PER_S

logger = logging.getLogger(__name__)
# Suffixes of a bag's files with messages.
_OF_BAGS = ('.db3', '.mcap', '.zstd')
# The unit of depth is checked in this number of frames.
_FRAMES_FOR_UNIT = 10
# With fewer boxes per image, a detector finds almost nothing. With fewer than the second number,
# it is tried with other inputs on the first images. Another input is right if it multiplies the
# scores by the last number. Chosen.
_NOTHING, _FEW_BOXES, _FIRST, _MORE = 0.3, 6.0, 3, 2.5
_UNKNOWN = np.full((4, 4), np.nan)


#: Every frame with a pose.
EVERY_FRAME = KeyframeOptions(0.0, 0.0)
_DEFAULT_KEYFRAMES = KeyframeOptions()


@dataclass(frozen=True)
class RecordingOptions:
    """Options for recording observations."""

    detector: DetectorOptions
    clip: ClipOptions | None  #: None: no embeddings
    keyframes: KeyframeOptions = _DEFAULT_KEYFRAMES
    #: All other settings that the frames depend on, such as topics, mount and depth format
    reading: str = ''
    workers: int = 1  #: Number of local processes; the result does not depend on it
    scheduler: str = ''  #: Address of a Dask scheduler; '' for none


def observation_file(frames: Frames, options: RecordingOptions) -> Path:
    """Return the observation file of a source in the cache; see `describe`.

    OptionsError: the folder of recordings cannot be written to.
    """
    make_folder(folder := recordings_folder())
    return folder / f'{_digest(describe(frames, options))}.npz'


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def describe(frames: Frames, options: RecordingOptions) -> str:
    """Return everything that the observations depend on, as JSON."""
    clip = options.clip
    files = [options.detector.model, options.detector.text_model]
    if clip is not None:
        files += [clip.model, clip.pretrained, clip.checkpoint_path]
    parts = _content(frames.source, _OF_BAGS)
    return json.dumps({
        # by content; frames that a program made have a name only
        'source': [frames.count, frames.digest or (not parts and frames.source.name), *parts],
        'detector': _settings(options.detector), 'clip': None if clip is None else _settings(clip),
        # Path('') is the working folder, whose state changes with every file written there
        'files': [_content(Path(file)) if file else None for file in files],
        'keyframes': asdict(options.keyframes), 'reading': options.reading})


def record_once(frames: Frames, options: RecordingOptions, file: Path | None = None,
                odometry: Mapping[str, Poses] | None = None) -> PosedDetections:
    """Return the observations of a source; record them unless an earlier run did.

    The networks do not depend on odometry, so that an earlier run without odometry is used too.

    Parameters
    ----------
    file : Path, optional
        The observation file; None: see observation_file.
    odometry : dict, optional
        Poses of each camera in the odometry frame, by the camera's name.

    Raises
    ------
    CliplocError
        The networks cannot be loaded, the source cannot be read, or the file cannot be written.
    """
    described = describe(frames, options)
    file = file or observation_file(frames, options)
    if file.exists():
        try:
            recorded = load_observations(file)
            if recorded.described == described:
                logger.warning('using the observations of an earlier run: %s', file)
                linked = _with_odometry(recorded, odometry)
                old, new = recorded.odom_from_camera, linked.odom_from_camera
                if new is not None and (old is None or not np.array_equal(old, new, True)):
                    save_observations(file, linked)
                return linked
            logger.warning('recording again, because the options changed: %s', file)
        except DatasetError as error:
            logger.warning('recording again: %s', error)
    path = file.with_name(outputs_name(frames, described))
    with _open_outputs(path) as outputs:
        recorded = _with_odometry(_record(
            frames, options, described, outputs, outputs.path == path), odometry)
    save_observations(file, recorded)
    logger.warning('wrote %s', file)
    _tell_about_networks(frames, options.detector, recorded)
    return recorded


def _tell_about_networks(frames: Frames, options: DetectorOptions, recorded: PosedDetections
                         ) -> None:
    """Tell if the images are grey, or the detector finds few boxes; try it with other inputs."""
    share, images, hint = len(recorded.classes) / max(1, len(recorded)), list[Any](), ''
    with suppress(DatasetError):  # such an image is left out of the recording, too
        images += (raw.color()[0] for raw in islice(frames.read_raw(lambda *_: True), _FIRST))
    if images and all(map(is_grey, images)):
        hint = GREY
    elif images and share < _FEW_BOXES:
        detector = load_detector(options)
        scores = detector.scores_by_input(images)
        own, best = next(iter(scores)), max(scores, key=lambda name: scores[name])
        if scores[best] > _MORE * max(scores[own], _NOTHING * len(images)):
            hint = (f'the detector finds more with an input of {best}: export it for {own}, or '
                    'correct preprocessor_config.json')
        elif share < _NOTHING:
            hint = (f'does the place have objects of its classes, {in_words(detector.class_names)}'
                    '? Give another --model, or a lower --conf')
    if hint:
        logger.warning('note: the detector finds %.1f boxes per image: %s', share, hint)


def _with_odometry(recorded: PosedDetections, odometry: Mapping[str, Poses] | None
                   ) -> PosedDetections:
    """Return observations with the odometry at their stamps; earlier odometry is replaced."""
    placed = None
    if odometry is not None:
        assert recorded.stamps_ns is not None
        poses = [odometry[recorded.name_of(frame)].pose_at(int(stamp_ns))
                 for frame, stamp_ns in enumerate(recorded.stamps_ns)]
        placed = np.array([_UNKNOWN if pose is None else pose for pose in poses])
    return replace(recorded, odom_from_camera=placed)


def record_every_frame(frames: Frames, look: Callable[[RawFrame], SeenFrame | str]
                       ) -> PosedDetections:
    """Run given networks on every frame with a pose; write no file.

    Frames that cannot be decoded are left out: for these, `look` returns the reason.
    """
    with _read_keyframes(frames, EVERY_FRAME) as (raws, filters):
        seen = [found for raw in raws if isinstance(found := look(raw), SeenFrame)]
    return _assemble(seen, frames, filters, '', '')


def outputs_name(frames: Frames, described: str) -> str:
    """Return the name of the file with the networks' outputs for the images of a source.

    Boxes do not depend on poses, whose scale may change, nor on the choice of keyframes.
    """
    content = parse_json(described.encode()) | {
        'keyframes': None, 'fields': list(SeenFrame.__dataclass_fields__)}  # of this release
    count, digest, *parts = content['source']
    if frames.digest and not parts:  # a folder: of images with cameras, and of poses
        content |= {'source': [count, digest.partition(' ')[0]], 'reading': None}
    return f'.{_digest(json.dumps(content))}.outputs'


@contextmanager
def _open_outputs(path: Path) -> Iterator[Log]:
    """Open a file of outputs; while another run adds to it, a temporary file."""
    def log(at: Path) -> Log:
        return Log(at, DatasetError, 'make room or name another file with `record_to`, then run '
                   'again: it continues from here', lambda line: SeenFrame.from_bytes(
                       base64.b64decode(parse_json(line))))
    with ExitStack() as opened:
        try:
            outputs = log(path)
        except DatasetError as error:
            if not isinstance(error.__cause__, BlockingIOError):
                raise
            outputs = log(opened.enter_context(unfinished(path, Path.mkdir)) / path.name)
        yield opened.enter_context(closing(outputs))


def _again(seen: SeenFrame, raw: RawFrame) -> SeenFrame:
    """Return an earlier output for an image with its present pose and depth."""
    depths = spreads = np.full(len(seen.scores), np.nan, dtype=np.float32)
    if raw.depth is not None:
        _, camera = raw.color()
        depths, spreads = depths_of_boxes(raw.depth(), camera, seen.bboxes_in_image)
    assert raw.map_from_camera is not None
    return replace(seen, map_from_camera=raw.map_from_camera, depths=depths, depth_spreads=spreads)


def _record(frames: Frames, options: RecordingOptions, described: str, outputs: Log,
            lasts: bool) -> PosedDetections:
    """Run the networks on all keyframes without an earlier output.

    The file of outputs is removed at the end, unless it `lasts`: a later run finds it.
    """
    earlier = {(entry.camera, entry.place, entry.stamp_ns): entry for entry in outputs.read()[0]}
    if earlier:
        logger.warning('using the boxes of %d images of earlier runs: %s', len(earlier),
                       outputs.path)
    seen, unusable, is_kept = list[SeenFrame](), list[str](), bool(earlier)
    # PyTorch's rounding depends on the number of threads: with one thread per worker, the result
    # is the same for any number of workers and on a cluster
    networks = partial(load_networks, options.detector, options.clip,
                       threads=0 if options.workers == 1 and not options.scheduler else 1)

    def unseen(raws: Iterator[RawFrame]) -> Iterator[RawFrame]:
        for raw in raws:
            if (found := earlier.get((raw.camera, raw.place, raw.stamp_ns))) is None:
                yield raw
            else:
                seen.append(_again(found, raw))
    try:
        with _read_keyframes(frames, options.keyframes) as (raws, filters):
            for _, result in run_tasks(networks, unseen(raws), workers=options.workers,
                                       scheduler=options.scheduler):
                if isinstance(result, str):
                    unusable.append(result)
                    if len(unusable) > MOST_LEFT_OUT * frames.count:
                        break
                else:
                    outputs.append(base64.b64encode(result.to_bytes()).decode())
                    seen.append(result)
                    is_kept = True
                    # refuse an implausible unit at once, not after hours of work
                    if len(seen) <= _FRAMES_FOR_UNIT:
                        check_depth_unit(np.concatenate([frame.depths for frame in seen]),
                                         str(frames.source))
        if len(unusable) > MOST_LEFT_OUT * (len(seen) + len(unusable)):
            raise DatasetError(unusable[0])
        encoder_key = '' if options.clip is None else resolve_clip_weights(options.clip).key
        found = _assemble(seen, frames, filters, encoder_key, described)
    except BaseException as error:
        # an unusable source fails again; after a change, it has another name
        is_kept &= not isinstance(error, DatasetError) or isinstance(error.__cause__, OSError)
        if is_kept and lasts:
            logger.warning('the boxes of this run are kept in %s: run again to continue from '
                           'there, or delete it', outputs.path)
        raise
    finally:
        if not (is_kept and lasts):
            outputs.remove()
    if unusable:
        logger.warning('left out: %d images that cannot be used, such as %s', len(unusable),
                       unusable[0])
    return found


@contextmanager
def _read_keyframes(frames: Frames, options: KeyframeOptions
                    ) -> Iterator[tuple[Iterator[RawFrame], dict[str, KeyframeFilter]]]:
    """Yield the keyframes of all cameras, and their filters; show a progress bar on a terminal."""
    filters = {part.camera: KeyframeFilter(options) for part in frames.each}
    with tqdm(total=frames.count, desc='detector and CLIP', unit='image', disable=None) as bar:
        def wanted_of(part: Frames) -> Iterator[RawFrame]:
            def is_wanted(place: int, stamp_ns: int, pose: NDArray[np.float64] | None) -> bool:
                bar.update()
                return filters[part.camera](place, stamp_ns, pose)
            return part.read_raw(is_wanted)
        yield chain.from_iterable(map(wanted_of, frames.each)), filters


def _assemble(seen: list[SeenFrame], frames: Frames, filters: Mapping[str, KeyframeFilter],
              encoder_key: str, described: str) -> PosedDetections:
    """Return the observations of frames, in order of time.

    DatasetError: a camera has no frames, or its intrinsics change.
    """
    seen, source = sorted(seen, key=lambda frame: (frame.stamp_ns, frame.place)), frames.source
    cameras = tuple(_camera_of([frame for frame in seen if frame.camera == name],
                               f'{source}: {name}:' if name else f'{source}:', keyframes.asked,
                               frames.varies)
                    for name, keyframes in filters.items())
    camera_names = tuple(filters)
    rows = np.array([camera_names.index(frame.camera) for frame in seen])
    if frames.varies:
        cameras, rows, camera_names = group_cameras([frame.pinhole for frame in seen])
        # boxes as the merged pinhole camera at the same pose would see them
        seen = [frame if frame.pinhole == cameras[row] else replace(
            frame, is_distorted=True, bboxes_xyxy=cameras[row].bboxes_in_pixels(
                frame.pinhole.normalize_bboxes(frame.bboxes_xyxy)))
            for frame, row in zip(seen, rows, strict=True)]

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(frame, name) for frame in seen])

    class_names, classes = np.unique(joined('class_ids'), return_inverse=True)
    has_depth = bool(np.isfinite(joined('depths')).any())
    needs_edges = len(classes) > 0 and any(frame.is_distorted for frame in seen)
    return PosedDetections(
        cameras=cameras,
        map_from_camera=np.array([frame.map_from_camera for frame in seen]),
        stamps_s=np.array([frame.stamp_ns / NS_PER_S for frame in seen]),
        frame_offsets=np.cumsum([0, *(len(frame.scores) for frame in seen)]),
        bboxes_xyxy=joined('bboxes_xyxy'), class_names=tuple(map(str, class_names)),
        classes=classes.reshape(-1), scores=joined('scores'),
        depths=joined('depths') if has_depth else None,
        depth_spreads=joined('depth_spreads') if has_depth else None,
        embeddings=(joined('embeddings') if any(frame.embeddings.shape[1] for frame in seen)
                    else None), encoder_key=encoder_key,
        open_edges=joined('open_edges') if needs_edges else None,
        camera_rows=None if camera_names == ('',) else rows, camera_names=camera_names,
        stamps_ns=np.array([frame.stamp_ns for frame in seen], dtype=np.int64),
        images=sum(keyframes.asked for keyframes in filters.values()),
        without_pose=sum(keyframes.without_pose for keyframes in filters.values()),
        described=described)


def _camera_of(seen: list[SeenFrame], where: str, images: int, varies: bool) -> Camera:
    """Return the camera of frames; of the first frame if the camera may vary.

    DatasetError: there are no frames, their cameras differ, or the unit of depth is implausible.
    """
    if not seen:
        raise DatasetError(f'{where} none of {images} images has a pose; interpolate over wider '
                           'gaps with `max_gap`, or record poses with the images')
    camera = seen[0].pinhole
    other = next((frame for frame in seen if frame.pinhole != camera), None)
    if other is not None and not varies:
        raise DatasetError(f'{where} the camera changes at {other.stamp_ns / NS_PER_S:.6f} s; '
                           'name several cameras with `cameras`')
    check_depth_unit(np.concatenate([frame.depths for frame in seen]), where.removesuffix(':'))
    return camera


def _settings(options: DetectorOptions | ClipOptions) -> dict[str, Any]:
    """Return the options that change the output of a network."""
    return {name: value for name, value in asdict(options).items() if name != 'cache_dir'}


def _content(path: Path, suffixes: tuple[str, ...] = ('',)) -> list[str]:
    """Return the fingerprints of a file, or of files in a folder; none for other names."""
    files = [path] if path.is_file() else sorted(
        file for file in path.rglob('*') if file.is_file() and file.name.endswith(suffixes))
    return [fingerprint_file(file) for file in files]


def check_depth_unit(depths_m: NDArray[np.float32], where: str) -> None:
    """Refuse depths of boxes that are implausible in a room or hall.

    DatasetError: the median is implausible; the message says how to set the unit.
    """
    known = depths_m[np.isfinite(depths_m)]
    if len(known) == 0:
        return
    median, (least, greatest) = float(np.median(known)), PLAUSIBLE_DEPTH_M
    if not least < median < greatest:
        raise DatasetError(
            f'{where}: the median depth of the boxes is {median:.4g} m, expected {least} to '
            f'{greatest:.0f} m: wrong unit? give `depth_unit` (0.001 for mm, 0.0002 for TUM)')
