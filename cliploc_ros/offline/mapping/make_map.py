# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping as a library: make a map with labels, embeddings and keyframes from a recording."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import (
    KeyframeLayer,
    layer_path,
    load_layer_of_map,
    removed_layer,
    save_layer,
)
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings, load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import load_removed, removed_path, write_landmarks, write_map
from cliploc_ros.core.map.parameter_file import read_text
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.tag_detection import detect_tags
from cliploc_ros.errors import MapError, MappingError, ModelError, counted
from cliploc_ros.files.storage import WriteOfSet
from cliploc_ros.models.onnx_clip import ClipWeights, names_onnx, resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions
from cliploc_ros.models.xfeat import feature_kinds
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.datasets.map_recording import MapRecording, recording_path, save_recording
from cliploc_ros.offline.datasets.observations import save_observations
from cliploc_ros.offline.mapping.building import MappingReport, Progress, build_map
from cliploc_ros.offline.mapping.labelling import embed_landmarks, embed_phrases, label_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks, classes_of
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.systematic import MountCorrection
from cliploc_ros.offline.mapping.tags import MappedTags, map_tags, seen_tags
from cliploc_ros.offline.mapping.update.updating import UpdatedMap, UpdateReport
from cliploc_ros.offline.mapping.update.updating import update_map as update_landmarks
from cliploc_ros.offline.recording.joining import join_layers
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.offline.recording.updating import UpdatedLayer, check_belongs, update_layer
from cliploc_ros.offline.vocabulary.vocabulary import load_vocabulary, shipped_phrases

# A scale by objects of known size: greatest number of trial maps, and the relative change of the
# scale below which they end.
_TRIALS, _SAME_SIZE = 4, 0.01


@dataclass(frozen=True)
class MadeMap:
    """A map and the files next to it."""

    landmark_map: LandmarkMap
    report: MappingReport | UpdateReport  #: Landmarks found and objects left out, with reasons
    embeddings: LandmarkEmbeddings | None = None  #: Embeddings of the crops of each landmark
    layer: KeyframeLayer | None = None
    mount: MountCorrection | None = None  #: Correction of the mount, if requested
    note: str = ''  #: The reason why the requested layer is missing
    removed: LandmarkMap | None = None  #: Landmarks that updates removed from the map
    keyframes: UpdatedLayer | None = None  #: What an update made of the keyframes
    updated: str = ''  #: Text of the map that was updated: the studio may change it meanwhile


@dataclass(frozen=True)
class Labeller:
    """Labels landmarks with phrases, or with their class if there is no CLIP."""

    vocabulary: Mapping[str, tuple[str, ...]]  #: Further phrases by class
    #: The CLIP that made the embeddings of the recording, with its weights; None: labels are class
    #: names
    clip: ClipOptions | None = None
    weights: ClipWeights | None = None
    note: str = ''  #: The reason why labels are class names; '' if they are not

    def describe(self, landmark_map: LandmarkMap, detections: PosedDetections,
                 shown: NDArray[np.int64]) -> tuple[LandmarkMap, LandmarkEmbeddings | None]:
        """Return the map with labels, and its image embeddings.

        `shown` (n,) has the row of the landmark of each box, -1 for none.
        CliplocError: the text tower cannot be loaded.
        """
        if not _has_embeddings(detections):
            return landmark_map, None
        embeddings = embed_landmarks(landmark_map.landmark_ids, detections, shown)
        if self.clip is None or self.weights is None:
            return landmark_map, embeddings
        names = sorted({name for row in range(len(landmark_map))
                        for name in classes_of(landmark_map, row)})
        # the user's phrases change more often than the shipped phrases
        parts = [(name, shipped_phrases(name)) for name in names] + [
            (name, texts) for name, texts in self.vocabulary.items() if name in names]
        found = embed_phrases(self.weights, self.clip, [texts for _, texts in parts])
        phrases = {name: [found[texts] for own, texts in parts if own == name] for name in names}
        return label_landmarks(landmark_map, embeddings, phrases), embeddings


def find_labeller(detections: PosedDetections, clip: Callable[[], ClipOptions] | None,
                  vocabulary: Path | None = None) -> Labeller:
    """Return the labeller for the landmarks of a recording.

    Parameters
    ----------
    clip : callable, optional
        Returns the CLIP of the recording; called only if the recording has embeddings. None:
        labels are class names.
    vocabulary : Path, optional
        Phrases by class (YAML), in addition to the shipped phrases.

    Raises
    ------
    OptionsError, ModelError
        The vocabulary is invalid, or it is given although labels can only be class names.
    """
    words = {} if vocabulary is None else load_vocabulary(vocabulary)
    try:
        if clip is None:
            raise ModelError('`no_clip` was given')
        if not _has_embeddings(detections):
            raise ModelError('the observations have no CLIP embeddings that name their encoder; '
                             'record them again with CLIP')
        options = clip()
        return Labeller(words, options, _weights_of(detections, options))
    except ModelError as error:
        if vocabulary is not None:
            raise
        return Labeller(words, note=f'labels are class names: {error}')


def _weights_of(detections: PosedDetections, clip: ClipOptions) -> ClipWeights:
    """Return the weights that made the embeddings; ModelError: the options name others."""
    hint = 'give the profile, or the CLIP model with its weights, of the recording'
    theirs = detections.encoder_key.split(':')[0]
    ours = Path(clip.model).stem if clip.model.endswith('.json') else clip.model.replace('/', '-')
    # compared first, to avoid a useless download of the weights of another model
    if not names_onnx(clip) and ours != theirs:
        raise ModelError(f"the embeddings are of CLIP model '{theirs}', not '{ours}'; {hint}")
    weights = resolve_clip_weights(clip)
    if weights.key != detections.encoder_key:
        raise ModelError(f'the embeddings are of the weights {detections.encoder_key}, not '
                         f'{weights.key}; {hint}')
    assert detections.embeddings is not None
    if detections.embeddings.shape[1] != weights.embed_dim:
        raise ModelError(f'the embeddings have {detections.embeddings.shape[1]} numbers, but '
                         f'those of {weights.key} have {weights.embed_dim}; record them again')
    return weights


def _has_embeddings(detections: PosedDetections) -> bool:
    embeddings = detections.embeddings
    return embeddings is not None and embeddings.size > 0 and bool(detections.encoder_key)


def make_map(detections: PosedDetections, labeller: Labeller,
             options: MappingOptions | None = None, frames: Frames | None = None,
             layer: LayerOptions | KeyframeLayer | None = None, progress: Progress | None = None
             ) -> MadeMap:
    """Make a map from a recording.

    If no landmark is found, keyframes alone make a map. If the images give no keyframes,
    landmarks alone do, and the map has a note.

    Parameters
    ----------
    detections : PosedDetections
        Boxes and poses of the recording, from ``load_observations``, or from ``record_once`` for
        images.
    labeller : Labeller
        See find_labeller.
    frames : Frames, optional
        The images, for the layer of keyframes.
    layer : LayerOptions or KeyframeLayer, optional
        Options, or keyframes that were built before. None: without keyframes.
    progress : callable, optional
        Called with the name of a stage and its progress, 0 to 1.

    Raises
    ------
    CliplocError
        The input does not allow a map; the message says what to correct.
    """
    options, failure = options or MappingOptions(), None
    try:
        built = build_map(detections, options, progress)
        landmark_map, embeddings = labeller.describe(built.landmark_map, detections, built.shown)
        made = MadeMap(landmark_map, built.report, embeddings, mount=built.mount)
    except MappingError as error:
        failure = error
        made = MadeMap(LandmarkMap.empty(options.frame_id), MappingReport(
            len(detections), 0, len(detections.classes), 0, 0.0, 0.0, 0.0, 0.0, 0.0,
            getattr(error, 'left_out', ()), (str(error),)))
    made = _with_layer(made, frames, layer)
    if failure is not None and made.layer is None:
        raise failure
    return made


def map_tags_of(frames: Frames, sizes: Mapping[str, float | None]) -> MappedTags:
    """Map the tags in the images of a recording, of the families and sizes of parse_sizes."""
    nothing = Detections(np.empty((0, 4)), (), np.empty(0))
    return map_tags(seen_tags(
        (Observation(seen.camera, nothing, tags=detect_tags(seen.image_rgb, seen.camera, sizes)),
         seen.map_from_camera) for seen in frames.read() if seen.map_from_camera is not None),
        sizes)


def _with_layer(made: MadeMap, frames: Frames | None, layer: LayerOptions | KeyframeLayer | None
                ) -> MadeMap:
    """Return a map with a layer, or with a note why the frames give none."""
    try:
        if isinstance(layer, LayerOptions):
            layer = None if frames is None else build_layer(frames, made.landmark_map, layer)
    except MappingError as error:
        return replace(made, note=f'no keyframes: {error}')
    return made if layer is None else replace(made, layer=replace(
        layer, frame_id=made.landmark_map.frame_id, landmark_ids=made.landmark_map.landmark_ids,
        landmark_centers=made.landmark_map.centers.astype(np.float32)))


def scale_of_objects(detections: PosedDetections, options: MappingOptions, class_name: str,
                     metres: float) -> tuple[float, int]:
    """Compute the metres per unit of the poses from the longest extent of a class's objects [m].

    The median of the objects in a trial map is used. Mapping uses sizes in metres, so that the
    trial is repeated with the scale found. The number of these objects is returned too.

    Raises
    ------
    MappingError
        The detections have depth, which determines the scale, or no object of the class is mapped.
    """
    if detections.depths is not None:
        raise MappingError('`object_size`: the recording has depth, which is in metres; give '
                           '`scale` if the poses are not')
    scale = 1.0
    for _ in range(_TRIALS):
        built = build_map(detections.moved(scale, np.eye(3)), options).landmark_map
        own = [row for row, class_id in enumerate(built.class_ids) if class_id == class_name]
        if not own:
            raise MappingError(
                f"`object_size`: no object of class '{class_name}' is mapped; the classes are "
                f'{", ".join(sorted(set(built.class_ids)))}')
        step = metres / float(np.median(2.0 * built.semi_axes[own].max(axis=1)))
        scale *= step
        if abs(step - 1.0) < _SAME_SIZE:
            break
    return scale, len(own)


def update_map(path: Path, detections: PosedDetections, labeller: Labeller,
               options: MappingOptions, frames: Frames | None = None,
               layer: LayerOptions | None = None) -> MadeMap:
    """Update the map in a file with a recording; the file is not written.

    Poses are refined against the map by the errors in ``pose_errors``; without these, if the boxes
    show that the poses are inaccurate. Keyframes are compared with those of the images; without
    images, they only lose the points on objects that are gone.

    Raises
    ------
    CliplocError
        The map is invalid, the recording does not belong to it, or the text tower cannot be
        loaded.
    """
    text = read_text(path)  # before the map
    old, place, kinds = LandmarkMap.from_file(path), layer_path(path), feature_kinds()
    old_layer = load_layer_of_map(place, old, kinds) if place.exists() else None
    if layer is not None and old_layer is not None:
        layer = replace(layer, kind=old_layer.kind)
    if len(old):
        found = update_landmarks(old, detections, options, load_embeddings_of_map(
            path, old.landmark_ids, old.map_set), load_removed(path, old.map_set.family))
        made = _with_layer(_label_new(found, detections, labeller), frames, layer)
        gone = found.gone
        if (new := made.layer) is not None:
            made = replace(made, layer=replace(
                new, map_from_camera=found.map_from_given @ new.map_from_camera))
    else:
        made, gone = make_map(detections, labeller, options, frames, layer), Landmarks.none()
    made = replace(made, updated=text, landmark_map=replace(made.landmark_map, tags=old.tags))
    if old_layer is None:
        return made
    keyframes = update_layer(old_layer, made.layer, gone)
    if not len(old):
        check_belongs(keyframes)
    removed = [] if keyframes.removed is None else [keyframes.removed]
    with suppress(MapError):  # there is none, or it is of another map
        removed.append(load_layer_of_map(layer_path(removed_path(path)), old, kinds))
    return replace(_with_layer(made, None, keyframes.layer), keyframes=keyframes._replace(
        removed=join_layers(removed) if removed else None))


def _label_new(updated: UpdatedMap, detections: PosedDetections, labeller: Labeller) -> MadeMap:
    """Label the new landmarks of an updated map; the others keep their labels."""
    landmark_map, first, report = updated.landmark_map, updated.first_new, updated.report
    if first < len(landmark_map):
        new, _ = labeller.describe(
            landmark_map.select(range(first, len(landmark_map))), detections,
            np.where(updated.shown >= first, updated.shown - first, -1))
        texts = dict(zip(new.landmark_ids, new.labels, strict=True))
        landmark_map = replace(landmark_map, labels=landmark_map.labels[:first] + new.labels,
                               details=landmark_map.details[:first] + new.details)
        report = replace(report, new=tuple(replace(landmark, label=texts[landmark.landmark_id])
                                           for landmark in report.new))
    return MadeMap(landmark_map, report, updated.embeddings, removed=updated.removed)


def write_made_map(path: Path, made: MadeMap, comments: Iterable[str], recording: MapRecording,
                   updated: Path | None = None, together: PosedDetections | None = None
                   ) -> list[str]:
    """Write a map and the files next to it as one set; return lines about its keyframes.

    The keyframes of a map that is replaced are removed if the new one has none. The detections of
    several recordings `together`, with poses in the map, get a file next to it.

    CliplocError: a file cannot be written, or another program changed the map while it was
    updated; nothing was changed.
    """
    is_in_place = updated is not None and path.resolve() == updated.resolve()
    if is_in_place and read_text(path) != made.updated:
        raise MapError(f'{path}: another program changed it during this update; update again')
    besides: dict[Path, WriteOfSet | None] = {}
    if together is not None:
        recording = replace(recording, observations=path.with_suffix('.recordings.npz'))
        # with the poses of the first recording
        found = together.moved(1.0 / recording.scale, np.array(recording.rotation).T)
        besides[recording.observations] = lambda place, _: save_observations(place, found)
    besides |= {
        recording_path(path): partial(save_recording, path, recording),
        removed_path(path): partial(
            write_landmarks, landmark_map=made.removed) if made.removed else None}
    for place, layer in ((layer_path(path), made.layer), (
            layer_path(removed_path(path)), made.keyframes and made.keyframes.removed)):
        besides[place] = None if layer is None else partial(_write_layer, layer)
    had_layer = layer_path(path).exists()
    write_map(path, made.landmark_map, comments, made.embeddings, besides)
    if made.layer is None:
        return [removed_layer(path)] * had_layer
    megabytes = layer_path(path).stat().st_size / 1e6
    return [f'{counted(len(made.layer), "keyframe")} of {megabytes:.1f} MB in '
            f'{layer_path(path).name}']


def _write_layer(layer: KeyframeLayer, place: Path, digest: str) -> None:
    save_layer(place, replace(layer, set_digest=digest))
