# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer with four cameras: together they see enough, and none blocks the others."""

import numpy as np
import pytest
from cameras import MAP, MOUNTS, NAMES, look
from frames import header_of, messages_of
from processes import wait_for
from scene import write_map
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from tester import RELIABLE, ask_until, transform_of
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.geometry.transforms import pose_error

BASE_FROM_CAMERA = [float(number) for mount in MOUNTS for number in (
    *mount[:3, 3], *Rotation.from_matrix(mount[:3, :3]).as_quat())]
# Clock offset of an unsynchronized camera [s].
NEVER = 1000.0


@pytest.fixture(scope='module')
def four_cameras(start_shared, tester, tmp_path_factory):
    """Start a relocalizer; return it, and a function that requests while some cameras publish."""
    folder = tmp_path_factory.mktemp('surroundings')
    write_map(MAP, folder / 'map.yaml')
    publishers = {name: {kind: tester.create_publisher(kind, f'{name}/{topic}', RELIABLE)
                         for kind, topic in ((CameraInfo, 'camera_info'), (Image, 'image'),
                                             (Detection2DArray, 'detections'))} for name in NAMES}
    process = start_shared('nodes.relocalizer', parameters={
        'map_file': folder / 'map.yaml', 'matching': 'class', 'base_frame': 'base_link',
        'tilt_deviation_deg': 0.0, 'time_budget_ms': 5000.0, 'cameras': list(NAMES),
        'base_from_camera': BASE_FROM_CAMERA})
    process.wait_for_output('ready after')
    tester.connect()
    rng, number = np.random.default_rng(4), 0

    def publish(working, late_s):
        nonlocal number
        number += 1
        for name, seen in zip(NAMES, look(rng), strict=True):
            if name not in working:
                continue
            nanoseconds = round(number * 1e8) + 10**12 - round(late_s.get(name, 0.0) * 1e9)
            for msg in messages_of(seen.detections, header_of(
                    0 if late_s.get(name) == NEVER else nanoseconds, f'{name}_optical')):
                publishers[name][type(msg)].publish(msg)

    def ask(working=NAMES, late_s=None):
        future = tester.ask()

        def work():
            publish(working, late_s or {})
            for _ in range(4):
                tester.spin()
        wait_for(future.done, 'an answer', work=work)
        return future.result()
    yield process, ask
    for kinds in publishers.values():
        for publisher in kinds.values():
            tester.destroy_publisher(publisher)


def test_four_cameras_see_enough_at_once(four_cameras, tester):
    process, ask = four_cameras
    while not ask_until(ask, ' in 4 images; ').success:
        tester.forget()
    tester.wait(lambda: tester.poses, 'a pose')
    assert pose_error(transform_of(tester.poses[-1].pose.pose), np.eye(4))[0] < 0.3
    assert 'Traceback' not in process.output()


def test_the_doctor_looks_at_each_camera(four_cameras, start):
    _, ask = four_cameras
    doctor = start('cli.doctor', '--timeout', 5)  # a busy machine discovers cameras slowly
    ask(working=NAMES[1:])
    while doctor.alive:
        ask(working=NAMES[1:])
    found = {tuple(line.split()[:2]) for line in doctor.output().splitlines()}
    for name in NAMES:
        state = 'fail' if name == NAMES[0] else 'pass'
        assert (f'{name}/camera', state) in found
    assert ('input', 'pass') in found


@pytest.mark.parametrize(('working', 'late_s'), [
    (NAMES[1:], {}), (NAMES, {'left': NEVER})])
def test_a_camera_that_is_late_or_silent_is_left_out_and_named(four_cameras, working, late_s):
    process, ask = four_cameras
    missing = next(iter(late_s), None) or next(name for name in NAMES if name not in working)
    ask_until(ask, f'no image of {missing};', working, late_s)
    assert 'Traceback' not in process.output()
