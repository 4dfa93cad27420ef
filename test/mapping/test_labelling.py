# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Labels and image embeddings of a built map, on simulated embeddings; phrases of labels."""

import re
from dataclasses import replace

import numpy as np
import pytest
from walk import make_table, see, walk_around

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import OptionsError, misspelt_classes
from cliploc_ros.offline.mapping.labelling import embed_landmarks, label_landmarks
from cliploc_ros.offline.vocabulary import vocabulary
from cliploc_ros.offline.vocabulary.vocabulary import Phrases

SIZE = 32


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def with_crops(detections, crops):
    return replace(detections, embeddings=np.asarray(crops, dtype=np.float16),
                   encoder_key='simulated')


@pytest.fixture
def static():
    """Return ten frames at one place, then one at each of two others, with one box each."""
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[10, 0, 3], poses[11, 0, 3] = 1.0, 2.0
    seen = see(make_table(1), walk_around(12, 90.0))
    assert len(seen.classes) == 12
    return replace(seen, map_from_camera=poses)


def test_weights_are_those_of_clip():
    axes = np.eye(SIZE, dtype=np.float32)
    crop = unit(axes[0] + 0.99 * axes[1] + 0.9 * axes[2])
    embeddings = replace(
        embed_landmarks(['a'], with_crops(see(make_table(1), walk_around(1)), crop[None]),
                        np.array([0])), landmark_ids=('thing_0',))
    phrases = {'book': [Phrases(('zero', 'one'), axes[:2]), Phrases(('two',), axes[[2]])]}
    (first, second, third) = label_landmarks(make_table(1), embeddings, phrases).details[0].labels
    assert (first[0], second[0], third[0]) == ('zero', 'one', 'two')
    assert first[1] / second[1] == pytest.approx(np.exp(100 * (crop[0] - crop[1])), rel=0.1)
    assert third[1] > 0.0


def test_frames_of_one_viewpoint_share_the_weight_of_one(static):
    axes = np.eye(SIZE)
    crops = axes[[0] * 10 + [1, 2]]
    mean = embed_landmarks(['it'], with_crops(static, crops), np.zeros(12, dtype=int)).means[0]
    np.testing.assert_allclose(mean[:3], np.full(3, 3 ** -0.5), atol=1e-3)
    assert not mean[3:].any()


def test_medoids_stand_for_all_crops(static):
    """Three looks of an object, one of them rare, give three medoids, each of them a crop."""
    axes = np.eye(SIZE)
    crops = unit(axes[[0] * 6 + [1] * 4 + [2, 1]] + 1e-3)
    embeddings = embed_landmarks(['no', 'it'], with_crops(static, crops), np.ones(12, dtype=int))
    assert embeddings.medoid_offsets.tolist() == [0, 0, 3]
    assert sorted(np.argmax(embeddings.medoids, axis=1)) == [0, 1, 2]
    assert embeddings.is_known.tolist() == [False, True]


def test_crops_that_say_nothing_leave_the_class_name(static):
    """Inputs are zero rows, crops that cancel out, and a landmark without boxes."""
    table = make_table(3)
    axes = np.eye(SIZE)
    crops = np.zeros((12, SIZE))
    crops[10], crops[11] = axes[0], -axes[0]
    shown = np.array([0] * 9 + [-1] + [1, 1])
    embeddings = embed_landmarks(table.landmark_ids, with_crops(static, crops), shown)
    assert not embeddings.is_known.any()
    assert embeddings.medoid_offsets.tolist() == [0, 0, 0, 0]
    assert label_landmarks(table, embeddings, {}).labels == table.labels


def test_a_landmark_of_two_classes_takes_phrases_of_both():
    axes = np.eye(SIZE, dtype=np.float32)
    table = make_table(1)
    embeddings = replace(
        embed_landmarks(['thing_0'], with_crops(see(table, walk_around(1)), axes[[1]]),
                        np.array([0])))
    phrases = {'book': [Phrases(('a book', 'a thing'), axes[[0, 2]])],
               'cup': [Phrases(('a cup', 'a thing'), axes[[1, 2]])]}
    assert label_landmarks(table, embeddings, phrases).labels == ('a book',)
    both = replace(table, details=(LandmarkDetails(class_weights=(('book', 0.7), ('cup', 0.3))),))
    labelled = label_landmarks(both, embeddings, phrases)
    assert labelled.labels == ('a cup',)
    assert [text for text, _ in labelled.details[0].labels] == ['a cup', 'a book', 'a thing']
    assert labelled.details[0].class_weights == both.details[0].class_weights


def test_many_crops_of_one_landmark_take_bounded_memory(static):
    """40,000 crops would need 12 GB for their cosines; the crops used are spread over all."""
    count = 40_000
    frames = 12
    offsets = np.linspace(0, count, frames + 1).astype(np.int64)
    many = replace(static, frame_offsets=offsets, classes=np.zeros(count, dtype=np.int64),
                   bboxes_xyxy=np.tile([0.0, 0, 9, 9], (count, 1)), scores=np.ones(count))
    crops = np.zeros((count, SIZE), dtype=np.float16)
    crops[:count // 2, 0] = crops[count // 2:, 1] = 1.0
    embeddings = embed_landmarks(['it'], with_crops(many, crops), np.zeros(count, dtype=int))
    assert embeddings.medoid_offsets.tolist() == [0, 2]
    assert embeddings.means[0, 1] > embeddings.means[0, 0] > 0.1  # later frames weigh more


# ---- phrases of the grammar, of the shipped vocabulary for COCO, and of a user's file
def test_a_small_grammar_written_out():
    assert vocabulary.expand_phrases({
        'phrases': ['a {kind}', 'a {colour} {name} {pattern}'],
        'kind': ['mug', 'tea cup'], 'colour': ['red', 'orange'],
        'pattern': ['with {second} dots', 'with a {second} label'],
    }) == ('a mug', 'a tea cup',
           'a red mug with orange dots', 'a red mug with an orange label',
           'an orange mug with red dots', 'an orange mug with a red label')


def test_a_symbol_has_one_value_in_a_phrase_and_phrases_are_told_once():
    assert vocabulary.expand_phrases({'phrases': ['{size} or {size}', 'big or big'],
                                      'size': ['big', 'tiny']}) == ('big or big', 'tiny or tiny')


@pytest.mark.parametrize(('rules', 'message'), [
    ({'phrases': ['a {brand}']}, 'add the rule brand'),
    ({'phrases': ['{a}'], 'a': ['{b}'], 'b': ['{a}']}, 'rules refer to each other'),
    ({'phrases': ['{second}'], 'colour': ['red']}, None),
    ({'phrases': ['{colour} {second}'], 'colour': ['red']}, 'needs two colours'),
    ({'phrases': ['{a} {b} {c} {d}'], **{name: [f'{name}{i}' for i in range(1000)]
                                         for name in 'abcd'}}, '2000 phrases')])
def test_rules_that_cannot_be_used(rules, message):
    if message is None:
        assert vocabulary.expand_phrases(rules) == ('red',)
        return
    with pytest.raises(OptionsError, match=message):
        vocabulary.expand_phrases(rules)


def test_shipped_phrases_are_english():
    for name in (*vocabulary.shipped_classes(), 'unheard-of thing'):
        phrases = vocabulary.shipped_phrases(name)
        assert 40 <= len(phrases) <= 1000
        assert len(set(phrases)) == len(phrases)
        for phrase in phrases:
            assert re.fullmatch(r"[a-z][a-z' -]+[a-z]", phrase)
            assert not re.search(r'\ba [aeio]|\ban [^aeiou]|  ', phrase), phrase
            assert len(phrase.split()) <= 14  # CLIP reads up to 75 tokens, the demo's CLIP 22


def test_any_class_name_is_described():
    assert 'a red tv monitor with blue stripes' in vocabulary.shipped_phrases('tv_monitor')
    assert 'a red colour' in vocabulary.shipped_phrases('{colour}')
    assert 'an object' in vocabulary.shipped_phrases('_')
    with pytest.raises(OptionsError, match='200 characters'):
        vocabulary.shipped_phrases('x' * 500)


def test_a_users_file_adds_phrases(tmp_path):
    file = tmp_path / 'our.yaml'
    file.write_text("cup:\n  - our {colour} team mug\n  - the chief's cup\n"
                    'robot:\n  grammar: device\n  kind: [robot, cleaning robot]\n'
                    "  brand: [Alpha]\n  phrases: ['a {colour} {brand} {kind}']\n")
    ours = vocabulary.load_vocabulary(file)
    assert ours['cup'][0] == 'our red team mug' and ours['cup'][-1] == "the chief's cup"
    assert 'a silver Alpha cleaning robot' in ours['robot']


def test_classes_that_look_misspelt_have_a_hint():
    assert misspelt_classes(['bokk', 'book', 'zebu', 'zebu'], vocabulary.shipped_classes()) == {
        'bokk': " (did you mean 'book'?)"}
