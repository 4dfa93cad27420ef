# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Phrases of the grammar, of the shipped vocabulary for COCO, and of a user's file."""

import re

import pytest

from cliploc_ros.errors import OptionsError, misspelt_classes
from cliploc_ros.offline.vocabulary import vocabulary


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
    assert misspelt_classes(['forklft', 'cart'], ['forklift', 'cart'], all_known=True) == {
        'forklft': " (did you mean 'forklift'?)"}
    assert misspelt_classes([], vocabulary.shipped_classes()) == {}
