# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio in a real browser, used as a person would, also with a hostile map."""

import numpy as np
import pytest
import yaml
from browser import Person, wait_for
from studio_map import ASSETS, person_at, write_two_rooms

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_select_type_relabel_undo_save_reload(person, studio, path):
    """The file contains exactly the typed text; every other line is unchanged."""
    document, before = studio.document, path.read_text()
    person.select(document, 'mug_2')
    person.mode('Edit')
    person.type('Position x', '5.5')
    wait_for(lambda: document.landmarks['mug_2'].center[0] == 5.5, 'the position')
    person.type('Label', 'a <b>green</b> mug & "brown" dots')
    wait_for(lambda: '"brown"' in document.landmarks['mug_2'].label, 'the label')
    person.type('Class', 'cup')
    wait_for(lambda: document.landmarks['mug_2'].class_id == 'cup', 'the class')
    person.picture('edited')
    person.page.keyboard.press('ArrowUp')
    person.page.get_by_text('moved mug_2 to 5.50 0.42 0.81 m').wait_for()
    person.page.keyboard.press('Control+z')
    person.page.get_by_text('undid: move mug_2').wait_for()
    person.page.keyboard.press('Control+z')
    wait_for(lambda: document.landmarks['mug_2'].class_id == 'mug', 'undo')
    assert path.read_text() == before
    person.click('Save')
    wait_for(lambda: document.is_saved, 'saving')
    person.page.reload()
    person.page.get_by_text('landmarks in map').first.wait_for()
    person.page.wait_for_function("() => [...document.querySelectorAll('input')].some("
                                  "input => input.value.includes('<b>green</b>'))")
    lost = [line.strip() for line in before.splitlines()
            if line not in path.read_text().splitlines()]
    won = [line.strip() for line in path.read_text().splitlines()
           if line not in before.splitlines()]
    assert lost == ['label: a green mug with brown dots', 'center: [5.28825, 0.32457, 0.81462]']
    assert won == ['label: "a <b>green</b> mug & \\"brown\\" dots"',
                   'center: [5.5, 0.32457, 0.81462]']
    assert LandmarkMap.from_file(path).labels[1] == 'a <b>green</b> mug & "brown" dots'


def test_boxes_are_drawn_dragged_and_linked(person, studio):
    """Draw a box with the mouse and drag its edge; the next view shows the object's place."""
    person.mode('Create')
    person.draw_box(studio, 0, (300, 200, 360, 290))
    assert np.allclose(studio.new.boxes[0], (300, 200, 360, 290), atol=2.0)
    person.drag(person.on_image((360, 245)), person.on_image((400, 250)))
    person.page.mouse.up()
    wait_for(lambda: studio.new.boxes[0][2] > 395, 'the edge')
    assert np.allclose(studio.new.boxes[0], (300, 200, 400, 290), atol=2.0)
    person.page.get_by_text('changed the box of view 1').wait_for()
    person.page.keyboard.press('c')
    wait_for(lambda: studio.view != 0, 'a view from another side')
    person.page.locator('polyline.guess').wait_for(state='attached')
    person.picture('drawn')
    before = person.page.evaluate('$("image").viewBox.baseVal.width')
    person.page.mouse.move(*person.on_image((320, 240)))
    person.page.mouse.wheel(0, -600)
    wait_for(lambda: person.page.evaluate('$("image").viewBox.baseVal.width') < 0.7 * before,
             'the zoom')


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


@pytest.mark.clock  # software rendering of the scene needs an idle machine
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
        person.mode('Create')
        page.get_by_text('start the studio with --images DIR').wait_for()


def test_pages_that_share_a_selection_say_so_and_an_old_line_is_told(chromium, person, studio):
    first = person
    first.page.get_by_text('pages share').wait_for(state='detached')
    second = Person(chromium, first.page.url)
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


def test_layers_film_and_a_click_on_the_image(person, studio):
    """The scene's panel switches layers and plays views; a click sets the outline there."""
    page, handles = person.page, studio.server.scene._handle_from_node_name
    page.get_by_text('Layers and viewpoints').click()
    page.get_by_label('Cameras').click()
    wait_for(lambda: not handles['/cameras'].visible, 'hidden cameras')
    page.get_by_label('Follow the view').click()
    page.get_by_label('Follow the view').click()
    wait_for(lambda: handles['/cameras'].visible, 'cameras after following')
    person.click('Play the recording')
    wait_for(lambda: studio.view >= 3, 'the film')
    person.click('Stop')
    person.show_view(studio, 3)
    outline = next(iter(studio.recording.outlines(studio.document.landmarks, 3).values()))
    page.mouse.click(*person.on_image(outline[:2]))
    wait_for(lambda: studio.document.selection, 'the selection')
    page.mouse.click(*person.on_image((2, 2)))
    wait_for(lambda: not studio.document.selection, 'nothing there')
    page.get_by_text('checked 60 landmarks').first.wait_for(state='attached')
    person.mode('Create')
    page.wait_for_function('() => !state.selection.ids.length')
    person.mode('Review')
    wait_for(lambda: studio.document.selection == ('mug_1',), 'a landmark to review')
    page.evaluate("send('select', {id: 'plant_8'})")
    page.wait_for_function("() => $('rows').querySelector('[aria-selected=true]')")
    page.set_viewport_size({'width': 1000, 'height': 500})
    page.wait_for_function(
        "() => $('rows').querySelector('[aria-selected=true]').getBoundingClientRect().bottom"
        " <= $('rows').getBoundingClientRect().bottom + 1")
