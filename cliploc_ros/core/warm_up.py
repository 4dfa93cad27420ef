# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Call every compiled kernel once, on a tiny problem.

    python -m cliploc_ros.core.warm_up

compiles the kernels, as script/setup does.
"""

import logging
from multiprocessing import Process

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.fit.camera_fit import ERRORS, camera_jacobian, fit_camera
from cliploc_ros.core.fit.refinement import jacobian_of, one_to_one, refine_rig, residuals_of
from cliploc_ros.core.fit.verification import (
    camera_pose,
    make_rig,
    scores_of,
    verify_rig,
)
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import depth_errors
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoids
from cliploc_ros.core.kernels.compiled import warm_up
from cliploc_ros.core.keyframes.point_pose import free_focal, refine
from cliploc_ros.core.map.pairs import find_repeats, make_pairs
from cliploc_ros.core.map.similarities import keep_greatest
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, Scene, make_scene
from cliploc_ros.core.search.strategies import (
    Leaders,
    compatible_pairs,
    draw_ransac,
    search_exhaustively,
    search_progressively,
    search_samples,
)


def call_every_kernel() -> None:
    """Call every kernel that a relocalization needs, with three boxes and three landmarks."""
    call_search_kernels()
    call_fit_kernels()


def call_search_kernels() -> None:
    """Call the kernels that sample correspondences and search with them."""
    scene, pairs = _make_scene()
    list(search_samples(scene, draw_ransac(pairs, 1, np.random.default_rng(0)),
                        Leaders.none_yet()))
    list(search_exhaustively(scene, Leaders.none_yet()))
    list(search_progressively(scene, compatible_pairs(scene), Leaders.none_yet()))
    list(search_progressively(scene, compatible_pairs(scene), Leaders.none_yet(), size=2))


def call_fit_kernels() -> None:
    """Call the kernels that verify and refine poses, and those that prepare a map."""
    scene, _ = _make_scene()
    rig = make_rig([scene], np.eye(4)[None], VERTICAL_UNKNOWN[None], np.zeros(3))
    refine_rig(rig, np.eye(3), np.zeros(3))
    found = verify_rig(rig, np.eye(3), np.zeros(3))
    inliers = one_to_one(rig, found, np.eye(3), np.zeros(3)).pairs
    camera_pose(rig.cameras[0], np.eye(3), np.zeros(3))
    residuals = np.empty(5 * len(inliers) + 3)
    residuals_of(inliers, VERTICAL_UNKNOWN, np.eye(3), np.zeros(3), residuals)
    camera_jacobian(inliers, VERTICAL_UNKNOWN, np.zeros(ERRORS), np.eye(3), np.zeros(3), residuals)
    fit_camera(inliers, np.ones((len(inliers), 4), dtype=np.bool_), VERTICAL_UNKNOWN, np.eye(3),
               np.zeros(3), np.ones(ERRORS))
    jacobian_of(inliers, VERTICAL_UNKNOWN, np.eye(3), np.zeros(3))
    depth_errors(scene.depths, scene.centers, scene.shapes, np.zeros(3), np.eye(3), np.zeros(3))
    project_ellipsoids(np.eye(4), scene.centers, scene.shapes)
    keep_greatest(np.ones((1, 1), np.float32), 0, np.zeros((1, 1), np.int64),
                  np.zeros((1, 1), np.float32))
    classes = np.zeros(3, dtype=np.int64)
    find_repeats(make_pairs(scene.centers, classes, cKDTree(scene.centers)), classes)
    scores_of(rig, np.eye(3)[None], np.zeros((1, 3)))
    points = np.indices((3, 3, 2)).reshape(3, -1).T + np.array([0.0, 0.0, 3.0])
    refine(points, points[:, :2] / points[:, 2:], np.eye(4))
    free_focal(points, points[:, :2] / points[:, 2:], np.eye(4))


def _make_scene() -> tuple[Scene, NDArray[np.int64]]:
    """Return a scene and its pairs of a box and a landmark (3, 2)."""
    bboxes = np.array([[100, 100, 150, 160], [300, 120, 360, 150], [200, 300, 260, 390]],
                      dtype=np.float64)
    pairs = np.array([[0, 0], [1, 1], [2, 2]], dtype=np.int64)
    centers = np.array([[0.0, 0, 5], [1, 0, 6], [0, 1, 5]])
    shapes = np.tile([0.04, 0.0, 0.0, 0.04, 0.0, 0.04], (3, 1))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    return make_scene(camera.normalize_bboxes(bboxes), centers, shapes,
                      np.ones((3, 3), dtype=np.bool_), pairs, 0.2), pairs


def main() -> None:
    """Compile the kernels that are not on disk yet, on two cores, and log where they are kept."""
    # The other process has stored the kernels of the fit when this process needs them.
    beside = Process(target=call_fit_kernels)
    beside.start()
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    warm_up(call_every_kernel)
    beside.join()


if __name__ == '__main__':
    main()
