# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keys, files that change, tokens, hostile maps and lost connections, in a real browser."""


import pytest
import yaml
from browser import wait_for
from studio_map import ASSETS, person_at

from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_a_hostile_map_is_shown_as_text(chromium, path):
    """Ids, labels, classes, unknown fields and the coordinate frame hold HTML and long texts."""
    # an id holds no dots
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
