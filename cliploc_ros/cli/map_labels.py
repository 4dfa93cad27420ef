# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options that say how to label a map, and what comes of them."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.cli.sources import clip_options
from cliploc_ros.errors import ModelError

if TYPE_CHECKING:
    from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.mapping.posed_detections import PosedDetections
    from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights
    from cliploc_ros.vocabulary.vocabulary import Vocabulary


def add_label_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of labels to a parser that has those of sources."""
    group = parser.add_argument_group('labels')
    group.add_argument('--vocabulary', type=Path, metavar='FILE',
                       help='phrases by class (YAML), besides the shipped ones')


class Encoder(NamedTuple):
    """The CLIP that made the embeddings of a recording, and its weights."""

    options: 'ClipOptions'
    weights: 'ClipWeights'


@dataclass(frozen=True)
class Labeller:
    """What describes the landmarks of a map.

    Parameters
    ----------
    vocabulary : Vocabulary
    encoder : Encoder, optional
        What made the embeddings; None: labels stay class names.
    note : str
        Why they do; '' where they do not.
    """

    vocabulary: 'Vocabulary'
    encoder: 'Encoder | None'
    note: str

    def describe(self, landmark_map: 'LandmarkMap', detections: 'PosedDetections',
                 shown: NDArray[np.int64]
                 ) -> 'tuple[LandmarkMap, LandmarkEmbeddings | None]':
        """Return the map with labels, and its image embeddings.

        Parameters
        ----------
        landmark_map : LandmarkMap
        detections : PosedDetections
        shown : ndarray (n,) of int
            Row of the landmark that each box shows, -1 for none.

        Raises
        ------
        CliplocError
            From loading the text tower.
        """
        from cliploc_ros.mapping.labelling import classes_of, embed_landmarks, label_landmarks

        if not _has_embeddings(detections):
            return landmark_map, None
        embeddings = embed_landmarks(landmark_map.landmark_ids, detections, shown)
        if self.encoder is None:
            return landmark_map, embeddings
        names = sorted({name for row in range(len(landmark_map))
                        for name in classes_of(landmark_map, row)})
        # The phrases of some classes; the user's change more often than the shipped.
        from cliploc_ros.models.phrase_embeddings import phrases_of_classes
        from cliploc_ros.vocabulary.vocabulary import shipped_phrases

        phrases = phrases_of_classes(self.encoder.weights, self.encoder.options, [
            {name: shipped_phrases(name) for name in names},
            {name: texts for name, texts in self.vocabulary.added.items() if name in names}])
        labelled = label_landmarks(landmark_map, embeddings, phrases)
        return labelled, embeddings


def prepare_labels(options: argparse.Namespace, detections: 'PosedDetections') -> Labeller:
    """Return what will label the map that detections become.

    Raises
    ------
    OptionsError, ModelError
        The vocabulary is invalid, or given where nothing can be labelled.
    """
    from cliploc_ros.vocabulary.vocabulary import load_vocabulary

    vocabulary = load_vocabulary(options.vocabulary)
    try:
        return Labeller(vocabulary, _find_encoder(options, detections), '')
    except ModelError as error:
        if options.vocabulary is not None:
            raise
        return Labeller(vocabulary, None, f'labels are class names: {error}')


def _find_encoder(options: argparse.Namespace, detections: 'PosedDetections') -> Encoder:
    """Return the encoder that made the embeddings; ModelError where it is not at hand."""
    from cliploc_ros.models.clip_weights import resolve_clip_weights

    if not options.clip:
        raise ModelError('--no-clip was given')
    if not _has_embeddings(detections):
        raise ModelError('the observations have no CLIP embeddings that name their encoder; '
                         'record them again with CLIP')
    clip = clip_options(options)
    key = detections.encoder_key
    hint = 'give the --profile, or --clip-model and --clip-pretrained, of the recording'
    # compared first, since the weights of another model would be downloaded in vain
    if _model_name(clip.model) != key.split(':')[0]:
        raise ModelError(f"the embeddings are of CLIP model '{key.split(':')[0]}', not "
                         f"'{_model_name(clip.model)}'; {hint}")
    weights = resolve_clip_weights(clip)
    if weights.key != key:
        raise ModelError(f'the embeddings are of the weights {key}, not {weights.key}; {hint}')
    assert detections.embeddings is not None
    if detections.embeddings.shape[1] != weights.embed_dim:
        raise ModelError(f'the embeddings have {detections.embeddings.shape[1]} numbers, but '
                         f'{weights.key} gives {weights.embed_dim}; record them again')
    return Encoder(clip, weights)


def _has_embeddings(detections: 'PosedDetections') -> bool:
    embeddings = detections.embeddings
    return embeddings is not None and embeddings.size > 0 and bool(detections.encoder_key)


def _model_name(model: str) -> str:
    return Path(model).stem if model.endswith('.json') else model.replace('/', '-')
