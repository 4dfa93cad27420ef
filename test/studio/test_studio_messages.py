# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages that the page never sends are refused, and the page keeps working for everybody."""

import io
import json
import logging
from contextlib import redirect_stdout

import pytest
from studio_map import demo_studio

NAN = float('nan')


@pytest.fixture(scope='module')
def page(tmp_path_factory):
    import viser

    from cliploc_ros.offline.studio.page import Page

    studio = demo_studio(tmp_path_factory.mktemp('messages') / 'map.yaml')
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer('127.0.0.1', 0, verbose=False)
    page = Page(studio, server)
    yield page
    page.stop()
    server.stop()
    studio.document.close()


@pytest.mark.needs('viser')
@pytest.mark.parametrize(('action', 'hostile'), [
    ('draw', [{'view': 5, 'corner': [[10, 10]], 'other': [[100, 100]]},
              {'view': 5, 'corner': [NAN, 0], 'other': [100, 100]},
              {'view': 5, 'corner': {'x': 1}, 'other': 'ab'},
              *({'view': view, 'corner': [10, 10], 'other': [100, 100]}
                for view in (True, -1, 5.0, '5', None, [5], 10**6))]),
    ('forget', [{'view': {}}, {'view': NAN}, {'self': 1}]),
    ('create', [{'label': {}, 'class_id': []}, {'label': None}]),
    ('show_layer', [{'name': 'more', 'is_shown': True}, {'name': ['Cameras'], 'is_shown': True},
                    {'name': 'Cameras', 'is_shown': NAN},
                    {'name': 'Cameras', 'is_shown': 10**100}]),
    ('edit', [*({'field': field, 'value': value}
                for field in ('center', 'by', 'angles', 'semi_axes', 'orientation', 'fields', {})
                for value in (None, 'abc', {'x': 1}, [1, 2], [[1, 2, 3]], [1, 2, NAN],
                              [1, 2, 10**400], [1e308, 1e308, 1e308])),
              *({'field': field, 'value': value} for field in ('label', 'class_id')
                for value in (None, '', {'a': NAN}, [1], 10**100, '\ud800', 'x' * 100_000))]),
    ('select', [{'id': {}}, {'id': ['mug_1'], 'joins': NAN}, {'id': '\ud800'}, {'id': None}]),
    ('step', [{'count': count} for count in ('x', 1.5, True, None, NAN, 10**400)]),
    ('show_view', [{'view': view} for view in ('x', None, [1], {}, NAN, 10**400, 1e300, -1e300)]),
    *((name, [{'ids': ids} for ids in ('mug_1', {'mug_1': 1}, [1], [['mug_1']], 5, ['more'])])
      for name in ('lock', 'hide')),
    ('look_at_landmark', [{'name': 1}, {}]), ('mode', [{'mode': {}}, {}]),
    ('relocalize_robot', [{}]), ('reload_robot', [{}]), ('check_map', [{'limit_s': NAN}]),
    ({'x': []}, [{}]), ('x' * 100_000, [{}]), ('_start', [{'name': 'save', 'values': {}}])],
    ids=lambda value: '' if isinstance(value, list) else str(value)[:20])
def test_hostile_messages_are_refused(page, caplog, action, hostile):
    """There is neither an internal error nor an impossible picture."""
    from cliploc_ros.offline.studio.page import parts_of

    desk, document = page.desk, page.desk.studio.document
    for values in hostile:
        document.select(['mug_1'])
        desk.do('person', json.loads(json.dumps({'do': action, **values})))
        for thread in list(desk.running.values()):
            thread.join()
        with document.lock:
            page._redraw()
            json.dumps(parts_of(desk), allow_nan=False)
        assert set(desk.layers) <= {'Cameras', 'Surfaces'}
    desk.do('person', {'do': 'save'})
    assert not [line for line in desk.lines if line[0] == 'error']
    assert all(len(text) <= 600 for _, text in desk.lines)
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert page._redrawer.is_alive()
