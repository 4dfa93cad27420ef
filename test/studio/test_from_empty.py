# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map that a person makes from nothing: boxes drawn in the browser, then wake-ups in this map.

The boxes are simulated: those of the visible part of each object, which the generator of the
demo's world recorded, with each edge off by 3 % of the box. The labels are that generator's, too.
"""

from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
from browser import wait_for
from studio_map import ASSETS, person_at

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.datasets.folders import tum_frames
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.demo.run import DemoOptions
from cliploc_ros.demo.truth import read_frames, read_objects
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.recording import make_queries_of
from cliploc_ros.evaluation.run import run_methods
from cliploc_ros.evaluation.summary import summarize
from cliploc_ros.evaluation.trials import make_queries
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.map_rows import embed_map
from cliploc_ros.models.yolo_detector import DetectorOptions
from cliploc_ros.recording.networks import LoadNetworks
from cliploc_ros.recording.recorder import record_every_frame
from cliploc_ros.studio import edits
from cliploc_ros.studio.document import Document
from cliploc_ros.studio.images import open_images, views_of_folder
from cliploc_ros.studio.landmark import map_of
from cliploc_ros.studio.recording import Recording, fit_boxes
from cliploc_ros.studio.studio import Studio

OBJECTS = 12
BOXES_EACH = 3
EDGE_ERROR = 0.03
BORDER_PX = 2.0


def sightings(walk):
    """Return by object the views that show it, with the box of its visible part."""
    found = defaultdict(list)
    for view, frame in enumerate(read_frames(walk)):
        for box in frame.boxes:
            found[box.object_id].append((view, box))
    return found


def is_inside(box, size):
    return box[:2].min() > BORDER_PX and (box[2:] < np.subtract(size, BORDER_PX)).all()


def chosen_views(seen, centers, size):
    """Return what a person draws in: views that show the object well, from different sides."""
    most = max(box.visibility for _, box in seen)
    seen = [(view, box) for view, box in seen
            if box.visibility >= 0.9 * most and is_inside(box.bbox_xyxy, size)]

    def least_distance(views):
        return min(np.linalg.norm(centers[one[0]] - centers[other[0]])
                   for one, other in combinations(views, 2))

    if len(seen) < 2:
        return []
    return max(combinations(seen, min(BOXES_EACH, len(seen))), key=least_distance)


def drawings(walk, views, rng):
    """Return the most visible objects, each with its boxes by view."""
    objects = {one.object_id: one for one in read_objects(walk)}
    camera, = views.cameras
    size, centers = (camera.width, camera.height), views.map_from_camera[:, :3, 3]
    found = sightings(walk)

    def visible(object_id):
        boxes = np.array([box.bbox_xyxy for _, box in found[object_id]])
        return len(boxes), float((boxes[:, 2:] - boxes[:, :2]).prod(axis=1).sum())

    drawn = []
    for object_id in sorted(found, key=visible, reverse=True):
        boxes = {view: box.bbox_xyxy + rng.normal(0.0, EDGE_ERROR, 4) * np.tile(
            box.bbox_xyxy[2:] - box.bbox_xyxy[:2], 2)
            for view, box in chosen_views(found[object_id], centers, size)}
        if boxes:
            drawn.append((objects[object_id], boxes))
    return drawn


def fitted(drawn, views):
    """Return the map that the studio makes of drawn boxes."""
    landmarks = {}
    for one, boxes in drawn:
        fit, _ = fit_boxes(len(boxes) * views.cameras, views.map_from_camera[list(boxes)],
                           np.array(list(boxes.values()), dtype=float))
        landmarks = edits.create(landmarks, one.label, one.class_id, fit.center, fit.basis
                                 ).apply(landmarks)
    return map_of(landmarks, 'map', 'drawn')


def only(landmark_map, objects):
    """Return a map with the landmarks of some objects: of their class, within 10 cm."""
    rows = []
    for one in objects:
        offsets_m = np.linalg.norm(landmark_map.centers - one.center, axis=1)
        offsets_m[np.array(landmark_map.class_ids) != one.class_id] = np.inf
        rows += [int(np.argmin(offsets_m))] * bool(offsets_m.min() < 0.1)
    texts = (tuple(getattr(landmark_map, name)[row] for row in rows)
             for name in ('landmark_ids', 'labels', 'class_ids'))
    return LandmarkMap(landmark_map.frame_id, *texts, landmark_map.centers[rows],
                       landmark_map.semi_axes[rows], landmark_map.quats_xyzw[rows])


def wake_ups(maps):
    """Return how the demo's networks localize the images of its query walk in each map."""
    options = DemoOptions(ASSETS, ASSETS)
    clip = ClipOptions(model=str(ASSETS / 'clip.json'),
                       pretrained=str(ASSETS / 'clip.safetensors'))
    sequence = read_tum(ASSETS / 'sequence')
    recorded = record_every_frame(
        tum_frames(sequence, find_camera(None, sequence.folder)[0]),
        LoadNetworks(DetectorOptions(model=str(ASSETS / 'yolo.pt')), clip)())
    found = {}
    for name, landmark_map in maps.items():
        queries = make_queries_of(recorded, landmark_map,
                                  embed_map(clip, landmark_map, [], 'text'))
        found[name], = summarize(run_methods(
            landmark_map, [Method(options.method, options.values.options())],
            make_queries(queries, landmark_map), trials=1))
    return found


@pytest.mark.clock
@pytest.mark.needs('viser', 'playwright', 'chromium')
def test_the_robot_wakes_up_in_a_map_made_in_the_browser(chromium, tmp_path):
    walk, path = ASSETS / 'mapping', tmp_path / 'map.yaml'
    views = views_of_folder(walk)
    more = drawings(walk, views, np.random.default_rng(0))
    drawn = more[:OBJECTS]
    objects = [one for one, _ in drawn]
    studio = Studio(Document(path), Recording(views), open_images(walk, None))
    with person_at(chromium, studio) as (person, _):
        person.page.set_viewport_size({'width': 900, 'height': 560})
        person.mode('Create')
        for count, (one, boxes) in enumerate(drawn, start=1):
            for view, box in boxes.items():
                person.draw_box(studio, view, box)
            person.name_new(one.label, one.class_id)
            person.click('Create↵')
            wait_for(lambda count=count: len(studio.document.landmarks) == count, 'the landmark')
        person.picture('from_empty')
        person.click('Save')
        wait_for(lambda: studio.document.is_saved, 'saving')
    made, true = LandmarkMap.from_file(path), LandmarkMap.from_file(ASSETS / 'map.yaml')
    assert len(made) == len(only(made, objects)) == OBJECTS
    offsets_m = np.linalg.norm(made.centers - [one.center for one in objects], axis=1)
    assert np.median(offsets_m) < 0.03
    ids = {one.object_id for one in objects}
    shown = np.array([sum(box.object_id in ids for box in frame.boxes)
                      for frame in read_frames(ASSETS / 'sequence')])
    print(f'centres {100 * np.median(offsets_m):.1f} cm off (median); of {len(shown)} images, '
          f'{(shown >= 3).sum()} show three of the {OBJECTS} objects or more')
    found = wake_ups({'drawn': made, 'true positions, the same objects': only(true, objects),
                      f'{len(more)} objects, drawn by the same script without the browser':
                      fitted(more, views), 'true positions, all objects': true})
    for name, summary in found.items():
        success = [(summary.errors_m[0] < limit_m).mean() for limit_m in (0.25, 0.5, 1.0)]
        print(f'{name}: success at .25, .5, 1 m {np.round(success, 2)}, '
              f'{summary.accepted.sum()} accepted, '
              f'{(summary.accepted & (summary.errors_m > 1.0)).sum()} of them wrong')
    drawn_m, true_m = (list(found.values())[row].errors_m[0] for row in (0, 1))
    assert (drawn_m < 0.5).sum() >= (true_m < 0.5).sum() - 2
    assert (drawn_m < 0.5)[shown >= 4].mean() > 0.7
    assert not (found['drawn'].accepted & (found['drawn'].errors_m > 1.0)).any()
    assert (list(found.values())[2].errors_m[0] < 0.25).mean() > 0.8, 'all objects'
