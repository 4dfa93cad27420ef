# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The prompts of open-vocabulary detectors: YOLO-World and YOLOE of ultralytics."""

import logging
from collections import Counter
from collections.abc import Sequence

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import OptionsError
from cliploc_ros.models.protocols import Prompts

#: Greatest number of texts of a vocabulary (not measured): LVIS has 1,203 classes, a room dozens.
MOST_TEXTS = 300

logger = logging.getLogger(__name__)


def prompts_of_names(names: str) -> Prompts:
    """Return the prompts of a list of names, such as 'mug, office chair'.

    OptionsError: there are no names, or too many.
    """
    texts = dict.fromkeys(filter(None, map(str.strip, names.split(','))))
    return _checked([(text, text) for text in texts], 'the vocabulary')


def prompts_of_map(landmark_map: LandmarkMap, source: str) -> Prompts:
    """Return the prompts of a map: its classes, and its labels with the class of their landmarks.

    A label shared by landmarks of several classes gets the most frequent class. If there are too
    many labels, the prompts are only the classes. OptionsError: there are no classes, or too many.
    """
    found = [(name, name) for name in dict.fromkeys(landmark_map.class_ids) if name.strip()]
    classes = {name for name, _ in found}
    owners: dict[str, Counter[str]] = {}
    for name, labels in zip(landmark_map.class_ids, landmark_map.weighted_labels, strict=True):
        for text, _ in labels:
            if name in classes and text.strip() and text not in classes:
                owners.setdefault(text, Counter())[name] += 1
    if len(found) + len(owners) <= MOST_TEXTS:
        found += [(text, names.most_common(1)[0][0]) for text, names in owners.items()]
    else:
        logger.warning('%s has %d classes and %d other labels, more than %d texts: the detector '
                       'looks only for the classes', source, len(found), len(owners), MOST_TEXTS)
    return _checked(found, source)


def _checked(prompts: Sequence[tuple[str, str]], source: str) -> Prompts:
    if not prompts:
        raise OptionsError(f'{source} names no class for the detector')
    if len(prompts) > MOST_TEXTS:
        raise OptionsError(f'{source} has {len(prompts)} classes for the detector, expected at '
                           f'most {MOST_TEXTS}: name the important ones in vocabulary')
    return tuple(prompts)
