# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of a camera, from its images."""

import cv2
import numpy as np
import pytest

from cliploc_ros.core.watch.camera import ImageFaults


def poses(count, step_m=0.2):
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, 0, 3] = step_m * np.arange(count)
    return found


@pytest.fixture
def images():
    """Six different images of boxes and lines."""
    rng, found = np.random.default_rng(0), []
    for _ in range(6):
        image = np.full((240, 320, 3), 120, dtype=np.uint8)
        for corner, size, color in zip(rng.integers(0, 300, (60, 2)), rng.integers(5, 60, (60, 2)),
                                       rng.integers(0, 255, (60, 3)), strict=True):
            cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), color.tolist(), -1)
        found.append(image)
    return found


def faults_of(images, where):
    faults = ImageFaults()
    return [faults.add(image, pose) for image, pose in zip(images, where, strict=True)]


def test_good_images_have_no_fault(images):
    assert faults_of(images, poses(6)) == [''] * 6


@pytest.mark.parametrize(('change', 'word', 'looks'), [
    (lambda one: one // 20, 'dark', 3),
    (lambda one: np.full_like(one, 90), 'covered', 3),
    (lambda one: cv2.GaussianBlur(one, (0, 0), 6.0), 'blurred', 5)])
def test_a_fault_that_lasts_is_named(images, change, word, looks):
    found = faults_of([change(one) for one in images], poses(6))
    assert found[:looks - 1] == [''] * (looks - 1)
    assert word in found[looks - 1]
    # one good image ends it
    again = faults_of([*map(change, images), images[0]], poses(7))
    assert again[-1] == ''


def test_the_same_image_is_frozen_only_for_a_robot_that_moves(images):
    assert 'frozen' in faults_of([images[0]] * 6, poses(6))[-1]
    assert faults_of([images[0]] * 6, poses(6, step_m=0.0)) == [''] * 6


def test_a_standing_robot_before_a_smooth_wall_is_no_fault(images):
    smooth = [cv2.GaussianBlur(images[0], (0, 0), 6.0) + np.uint8(row) for row in range(6)]
    assert faults_of(smooth, poses(6, step_m=0.0)) == [''] * 6


@pytest.mark.full
@pytest.mark.parametrize('shape', [(1, 1, 3), (480, 3, 3), (1080, 1920, 3)])
def test_images_of_any_shape(shape):
    faults_of([np.zeros(shape, dtype=np.uint8)] * 4, poses(4))
