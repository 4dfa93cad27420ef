# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keys, changed files, tokens, hostile maps and lost connections, in a real browser."""


import pytest
import yaml
from browser import Person, wait_for
from studio_map import ASSETS, person_at, write_two_rooms

from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_a_hostile_map_is_shown_as_text(chromium, path):
    """Ids, labels, classes, unknown fields and coordinate frame contain HTML and long texts."""
    # an id contains no dots
    attack = '<img src=x onerror="self[`hacked`]=1"><script>self[`hacked`]=1</script>'
    tree = yaml.safe_load((ASSETS / 'map.yaml').read_text())
    one = tree['/**']['ros__parameters']['map']
    one['frame_id'] = f'map{attack}'
    landmarks = one['landmarks']
    landmarks[attack] = {**landmarks.pop('mug_1'), 'label': attack, 'class_id': attack}
    landmarks['long'] = {**landmarks.pop('mug_2'), 'label': 'long ' * 199, 'class_id': 'c' * 999,
                         attack: attack}
    landmarks['i' * 100_000] = landmarks.pop('can_1')
    path.write_text(yaml.safe_dump(tree))
    studio = Studio(Document(path))
    with person_at(chromium, studio) as (person, _):
        for text in ('<img', 'long', 'iiiiiiii'):
            person.find(text)
            person.row(text).click()
            wait_for(lambda text=text: studio.document.selection
                     and studio.document.selection[0].startswith(text), text)
        person.select(studio.document, 'long')
        person.type('Label', 'x' * 100_000)
        person.page.get_by_text('longer than 1000 characters').wait_for()
        person.type('Label', 'short')
        wait_for(lambda: studio.document.landmarks['long'].label == 'short', 'the label')
        person.picture('hostile')
        assert person.page.evaluate('window.hacked') is None
        assert person.page.locator('img[src=x]').count() == 0


def test_without_views_the_scene_has_the_page_and_ids_tell_equal_labels_apart(chromium, path):
    """The labels of the two rooms' chairs are equal."""
    write_two_rooms(path)
    studio = Studio(Document(path))
    with person_at(chromium, studio, has_scene=True) as (person, server):
        page = person.page
        widths = page.evaluate("['scene', 'frame'].map(one => $(one).clientWidth)")
        assert widths == [page.evaluate("$('scene').parentElement.clientWidth"
                                        " - document.querySelector('aside').offsetWidth")] * 2

        for chair in ('chair_4', 'chair_9'):
            person.select(studio.document, chair)
            label = server.scene._handle_from_node_name['/labels/0']
            wait_for(lambda label=label, chair=chair: label.text == f'{chair}: a chair', 'it')
        person.picture('labels')


def test_pages_that_share_a_selection_say_so_and_an_old_line_is_told(chromium, studio):
    first = Person(chromium, studio.url)
    first.page.get_by_text('pages share').wait_for(state='detached')
    second = Person(chromium, studio.url)
    for person in (first, second):
        person.page.get_by_text('2 pages share the selection and the view').wait_for()
    second.page.close()
    first.page.wait_for_function("() => $('people').textContent === ''")
    first.page.get_by_text('checked 60 landmarks').first.wait_for(state='attached')
    first.select(studio.document, 'mug_2')
    first.page.evaluate("send('lock', {ids: ['mug_2']})")
    line = first.page.locator('footer div').first
    first.page.wait_for_function("() => $('log').firstChild.textContent.endsWith('locked mug_2')")
    first.select(studio.document, 'mug_3')
    first.page.wait_for_function(
        "() => $('log').firstChild.textContent === 'earlier: locked mug_2'")
    assert line.get_attribute('class') == 'past'
    first.page.close()


def test_a_narrow_page_leaves_room_for_the_scene_where_boxes_are_drawn(person):
    person.page.set_viewport_size({'width': 1100, 'height': 700})
    person.mode('Create')
    assert person.page.evaluate("$('scene').clientWidth") >= 360
    assert person.page.evaluate("$('view').clientWidth") >= 480
