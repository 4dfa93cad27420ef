# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which options a method's name stands for."""

import pytest

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS, parse_methods

PAPER = RelocalizerOptions(iterations=500, k=5, random_seed=4)


def test_all_are_the_papers_ten():
    methods = parse_methods(['all'], PAPER, 40)
    assert tuple(method.name for method in methods) == PAPER_METHODS
    for method in methods:
        assert f'{method.options.matching}_{method.options.algorithm}' == method.name
        assert (method.options.iterations, method.options.k) == (500, 5)
        assert method.draws_nothing == method.name.endswith('_bf')


def test_auto_is_what_the_node_does():
    method, = parse_methods(['auto'], PAPER, 40)
    assert method.options == RelocalizerOptions(random_seed=4)


def test_named_sets_of_options(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('wide: {base: hybrid_b-prosac, k: 9}\nstrict: {min_confidence: 0.9}\n')
    wide, strict = parse_methods([str(path)], PAPER, 40)
    assert (wide.name, wide.options.k, wide.options.iterations) == ('wide', 9, 500)
    assert (strict.options.min_confidence, strict.options.iterations) == (0.9, 10_000)


def test_keyframes_are_for_auto_and_what_is_based_on_it(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('strict: {min_confidence: 0.9}\nobjects: {keyframes: false}\n'
                    'wide: {base: hybrid_b-prosac}\n')
    methods = parse_methods(['auto', 'clip_bf', str(path)], PAPER, 40)
    assert [one.name for one in methods if one.keyframes] == ['auto', 'strict']


@pytest.mark.parametrize(('text', 'named'), [
    ('wide: {keyframes: 3}', 'mine.yaml: wide: keyframes: 3 is no bool'),
    ('wide: {kk: 9}', "mine.yaml: wide: 'kk' is none of base, matching"),
    ('wide: {k: many}', "mine.yaml: wide: k: 'many' is no int"),
    ('wide: 3', 'mine.yaml: wide: is not a mapping'),
    ('wide: {base: best}', "'best' is none of"),
    ('auto: {k: 2}', "two different methods are called 'auto'"),
    ('[1, 2]', 'holds no YAML mapping'), ('{', 'not valid YAML')])
def test_bad_files_are_named(tmp_path, text, named):
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(CliplocError) as caught:
        parse_methods(['auto', str(path)], PAPER, 40)
    assert named in str(caught.value)
