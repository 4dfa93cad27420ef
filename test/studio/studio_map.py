# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps and studios for the tests of the studio."""

import shutil
from contextlib import contextmanager

import numpy as np
from browser import Person

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.offline.datasets.images import open_images, views_of_folder
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.studio import Studio
from demo import ASSETS

_ROOM = np.array([[0.0, 0.0, 0.4], [0.9, 0.2, 0.6], [0.3, 1.1, 0.5], [1.2, 1.3, 0.8],
                  [-0.5, 0.8, 0.3]])
_CLASSES = ('cup', 'book', 'plant', 'cup', 'chair')

# Comments and all styles of YAML.
TEXT = """\
# The office on the second floor.   Measured by hand.
other_node:
  ros__parameters:
    rate: 5.0   # Hz
/**:
  ros__parameters:
    map:
      frame_id: map
      landmarks:
        # the red one, from the kitchen
        cup_1:
          label: 'a red cup'   # Ann's
          class_id: cup
          center: [1.0, 2.0, 0.5]   # from the plan
          semi_axes: [0.05, 0.05, 0.08]
          orientation: [0.0, 0.0, 0.0, 1.0]

        # shelf
        book_1:
          labels:
            text: ["a thick book", "a novel"]
            weight: [0.7, 0.3]
          class_id: book
          center:
            - 2.0
            - 2.0
            - 0.5
          semi_axes: [0.1, 0.15, 0.03]
          orientation: [0.0, 0.0, 0.0, 1.0]
          position_sigma: 0.01
          class_weights: {book: 0.9, tv: 0.1}
        plant_1:
          label: >
            a plant
            in a pot
          class_id: plant
          center: [3.0, 2.0, 0.5]
          semi_axes: [0.1, 0.15, 0.3]
          orientation: [0.0, 0.0, 0.0, 1.0]
    map_file: ''  # the relocalizer's own
"""


def demo_studio(path):
    """Return a studio of the demo's map, written to a path, with its walk's images and poses."""
    shutil.copy(ASSETS / 'map.yaml', path)
    folder = ASSETS / 'sequence'
    return Studio(Document(path), Recording(views_of_folder(folder), open_images(folder, None)))


@contextmanager
def open_page(studio, host='127.0.0.1'):
    """Serve the page of a studio; yield its URL and the server, and close the document."""
    from cliploc_ros.offline.studio.page import serve_studio

    try:
        with serve_studio(studio, host, 0) as (url, server):
            yield url.replace('0.0.0.0', '127.0.0.1'), server
    finally:
        studio.document.close()


@contextmanager
def person_at(chromium, studio, has_scene=False):
    """Serve the page of a studio, and open it; yield the person at the page and the server."""
    from cliploc_ros.offline.studio.web import private_page

    with open_page(studio) as (url, server), private_page(url, studio.document.path) as page:
        person = Person(chromium, page.as_uri(), has_scene)
        yield person, server
        person.page.close()
        assert person.foreign == [], 'no request leaves the machine'


def write_two_rooms(path):
    """Write the map of two rooms 7 m apart with equal labels."""
    centers = np.concatenate([_ROOM, _ROOM + np.array([7.0, 0.0, 0.0])])
    count = len(centers)
    classes = _CLASSES * 2
    write_map(path, LandmarkMap(
        'map', tuple(f'{name}_{row}' for row, name in enumerate(classes)),
        tuple(f'a {name}' for name in classes), classes, centers, np.full((count, 3), 0.15),
        np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))))
