# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Results of studies: measured, written, copied into pages, and protected from manual edits."""

import pytest

from studies import results


def test_a_result_has_its_command_and_its_sections(tmp_path, monkeypatch):
    monkeypatch.setattr(results, 'FOLDER', tmp_path)
    results.measure('small', 'studies.acceptance judge --worlds 1 --kinds room', tmp_path)
    text = (tmp_path / 'small.md').read_text()
    assert '| command | `python -m studies.acceptance judge --worlds 1 --kinds room` |' in text
    assert results.section('small', 'At a glance').startswith('| place | one image |')
    with pytest.raises(ValueError, match='no section In short, but At a glance'):
        results.section('small', 'In short')


def test_an_edit_by_hand_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(results, 'FOLDER', tmp_path)
    path = tmp_path / 'small.md'
    results.measure('small', 'studies.acceptance judge --worlds 1 --kinds room', tmp_path)
    with pytest.raises(ValueError, match=r'gone\.md is missing'):
        results.section('gone', 'At a glance')
    for edited in (path.read_text().replace(' of ', ' out of ', 1), 'no digest\n'):
        path.write_text(edited)
        with pytest.raises(ValueError, match=r'small\.md is missing or was edited: run python -m'):
            results.section('small', 'At a glance')


def test_a_command_that_fails_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(results, 'FOLDER', tmp_path)
    with pytest.raises(results.OptionsError, match='small: the command ended with 2'):
        results.measure('small', 'studies.acceptance judge --no-such-option', tmp_path)
    assert not list(tmp_path.iterdir())
