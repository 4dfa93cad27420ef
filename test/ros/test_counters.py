# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refusals by kind, and the hash of a map."""

import hashlib

import pytest
from scene import make_room, write_map

from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind, Rival, refusal
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import MapError
from cliploc_ros.ros.answer import Answer, RequestCounters, Verdict
from cliploc_ros.ros.map_parameters import load_hashed_map


@pytest.mark.parametrize(('kind', 'evidence'), [
    ('too_few_objects', Evidence(2, 1.0)),
    ('search_cut_short', Evidence(9, 1.0, coverage=0.1, tried=400)),
    ('search_cut_short', Evidence(9, 1.0, meetings=0.0, tried=900, coverage=0.5)),
    ('look_alike', Evidence(9, 1.0, distinct=0.5, twin=(1.0, 2.0, 3.0))),
    ('uncertain_position', Evidence(9, 1.0, near=0.5, deviation_m=2.0)),
    ('ambiguous', Evidence(9, 0.5, rival=Rival(0.5, (1.0, 2.0, 3.0)))),
    ('unexplained', Evidence(4, 0.5, unexplained=6.0)),
    ('frames_disagree', Evidence(9, 1.0, earlier=(0.0, 0.0, 0.0))),
])
def test_every_refusal_has_its_kind(kind, evidence):
    refused = refusal(evidence, RelocalizerOptions())
    assert refused is not None and refused.reason
    assert refused.kind == kind


def test_counts_add_up():
    counters = RequestCounters()
    counters.add(Answer(Verdict.ACCEPTED, 'x 1.00'), 0.5)
    counters.add(Answer(Verdict.REFUSED, 'a reason', kind=RefusalKind.AMBIGUOUS), 2.0)
    counters.add(Answer(Verdict.FAILED, 'no fresh frame'), 1.0)
    values = counters.values()
    assert values['requests'] == 3
    assert [values[f'requests {verdict}'] for verdict in Verdict] == [1, 1, 0, 1]
    assert {kind: values[f'refused: {kind}'] for kind in RefusalKind if values[f'refused: {kind}']
            } == {'ambiguous': 1}
    assert (values['requests total [s]'], values['requests longest [s]']) == ('3.500', '2.000')


def test_the_hash_of_a_file_is_that_of_sha256sum(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(make_room(), path)
    loaded, digest = load_hashed_map(None, [str(path)])
    assert len(loaded) == 12
    assert hashlib.sha256(path.read_bytes()).hexdigest().startswith(digest)
    assert len(digest) == 12
    path.write_text(path.read_text() + '# another one\n')
    assert load_hashed_map(None, [str(path)])[1] != digest
    with pytest.raises(MapError, match='No such file'):
        load_hashed_map(None, [str(tmp_path / 'none.yaml')])
