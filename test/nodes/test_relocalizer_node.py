# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process: requests, bad input, the end."""

import signal
import time

import numpy as np
import pytest
from conftest import make_frame, wait_for
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from scene import MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import CompressedImage

from cliploc_ros.core.observation import Detections
from cliploc_ros.core.transforms import pose_error, transform_from_pose
from cliploc_ros.ros.conversions import detections_to_msg


def transform_of(pose):
    p, q = pose.position, pose.orientation
    return transform_from_pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))


def call(tester, service_type, name, request):
    client = tester.create_client(service_type, name)
    tester.wait(client.service_is_ready, name)
    return tester.answer(client.call_async(request))


def set_parameter(tester, name, value):
    request = SetParameters.Request(
        parameters=[Parameter(name, value=value).to_parameter_msg()])
    return call(tester, SetParameters, '/relocalizer/set_parameters', request).results[0]


def test_a_request_is_answered_with_a_pose(relocalizer, tester):
    answer = tester.relocalize(make_frame(stamp_s=12.5))
    assert answer.success
    assert answer.message.startswith('accepted: x 0.3')
    tester.wait(lambda: tester.poses and tester.initial_poses and tester.hypotheses, 'poses')
    pose = tester.poses[0]
    assert pose == tester.initial_poses[0]
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == (
        'map', 12, 500_000_000)
    assert pose_error(transform_of(pose.pose.pose), MAP_FROM_CAMERA) < (0.05, 1.0)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert tester.hypotheses[0].poses[0] == pose.pose.pose


def test_the_map_can_come_as_parameters(start, tester, room_map):
    process = start('nodes.relocalizer', '--ros-args', '--params-file', room_map, '-p',
                    'matching:=class', '-p', 'algorithm:=bf')
    process.wait_for_output('12 landmarks')
    tester.connect()
    assert tester.relocalize(make_frame()).success


def test_the_navigation_stacks_own_service_wakes_up_too(relocalizer, tester):
    future = tester.ask_reinitialize()
    tester.wait_until_heard()
    tester.publish(make_frame())
    tester.answer(future)
    tester.wait(lambda: tester.initial_poses, 'an initial pose')


def test_between_requests_nothing_is_listened_to(relocalizer, tester):
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: tester.images.get_subscription_count() == 0
                and tester.detections.get_subscription_count() == 0, 'the subscriptions to end')
    before, start = relocalizer.cpu_s(), time.monotonic()
    tester.wait(lambda: time.monotonic() - start > 2.0, 'two seconds')
    idle = (relocalizer.cpu_s() - before) / (time.monotonic() - start)
    print(f'\nidle between requests: {100 * idle:.2f} % of a core, '
          f'{relocalizer.memory_mib():.0f} MiB')
    assert idle < 0.05


def test_compressed_images(start, tester, room_map):
    import cv2
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf',
        'image_transport': 'compressed'})
    process.wait_for_output('ready after')
    tester.connect()
    image, info, detections = make_frame()
    data = cv2.imencode('.jpg', np.zeros((480, 640, 3), dtype=np.uint8))[1].tobytes()
    good = CompressedImage(header=image.header, format='jpeg', data=data)
    assert tester.relocalize((good, info, detections)).success
    for broken in (b'', b'not a picture', data[:100]):
        bad = CompressedImage(header=image.header, format='jpeg', data=broken)
        answer = tester.relocalize((bad, info, detections))
        assert not answer.success
        assert 'does not decode' in answer.message
    assert tester.relocalize((good, info, detections)).success


def test_continuous_mode_publishes_without_being_asked(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'mode': 'continuous'})
    process.wait_for_output('ready after')
    tester.connect()
    tester.wait_until_heard()
    tester.publish(make_frame(stamp_s=1.0))
    tester.wait(lambda: len(tester.poses) == 1, 'a pose')
    tester.publish(make_frame(stamp_s=2.0))
    tester.wait(lambda: len(tester.poses) == 2, 'another pose')
    assert not tester.initial_poses  # a running localizer is never reset unasked
    assert tester.relocalize(make_frame(stamp_s=3.0)).success
    tester.wait(lambda: tester.initial_poses, 'an initial pose')
    assert process.stop()[0] == 0


def test_two_requests_at_once_are_both_answered(relocalizer, tester):
    futures = [tester.ask(), tester.ask(), tester.ask_reinitialize()]
    stamp = 0

    def feed():
        nonlocal stamp
        stamp += 1
        tester.publish(make_frame(stamp_s=stamp))
        tester.spin()
    wait_for(lambda: all(future.done() for future in futures), 'all answers', work=feed)
    assert futures[0].result().success
    assert futures[1].result().success


def test_the_mount_moves_the_pose(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'base_frame': 'base_link',
        'base_from_camera': '[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]'})
    process.wait_for_output('ready after')
    tester.connect()
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: tester.poses, 'a pose')
    base = MAP_FROM_CAMERA @ transform_from_pose(np.array([0, 0, -1.0]), np.array([0, 0, 0, 1.0]))
    assert pose_error(transform_of(tester.poses[0].pose.pose), base) < (0.08, 1.0)


def test_no_mount_is_an_answer_not_an_end(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'base_frame': 'base_link',
        'tf_timeout_s': 0.1})
    process.wait_for_output('ready after')
    tester.connect()
    answer = tester.relocalize(make_frame())
    assert not answer.success
    assert 'base_from_camera' in answer.message
    assert process.alive


@pytest.mark.parametrize(('topics', 'reason'), [
    ((), 'no image'),
    (('camera_info', 'detections'), 'no image'),
    (('image', 'detections'), 'no camera_info'),
    (('image', 'camera_info'), 'no detections'),
    (('image', 'camera_info', 'late'), 'stamps never match'),
])
def test_a_request_without_fresh_frames_says_why(relocalizer, tester, topics, reason):
    set_parameter(tester, 'timeout_s', 1.5)
    future = tester.ask()
    tester.wait_until_heard()
    image, info, detections = make_frame(stamp_s=5.0)
    late = make_frame(stamp_s=5.001)[2]
    for topic in topics:
        {'image': tester.images, 'camera_info': tester.infos, 'detections': tester.detections,
         'late': tester.detections}[topic].publish(
             {'image': image, 'camera_info': info, 'detections': detections, 'late': late}[topic])
    answer = tester.answer(future)
    assert not answer.success
    assert 'no fresh frame within 1.5 s' in answer.message
    assert reason in answer.message
    assert tester.relocalize(make_frame(stamp_s=6.0)).success


def bad_image(**changes):
    def change(image, info, detections):
        for name, value in changes.items():
            setattr(image, name, value)
    return change


def bad_info(**changes):
    def change(image, info, detections):
        for name, value in changes.items():
            setattr(info, name, value)
    return change


def bad_boxes(boxes, class_id='a'):
    def change(image, info, detections):
        rows = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        detections.detections = detections_to_msg(
            Detections(rows, (class_id,) * len(rows), np.full(len(rows), 0.5)),
            detections.header).detections
    return change


NAN, INF = float('nan'), float('inf')
BAD_FRAMES = {
    'unknown encoding': (bad_image(encoding='yuv422'), "encoding 'yuv422' is none of"),
    'no width': (bad_image(width=0), 'image size 0x480'),
    'no size': (bad_image(width=0, height=0, data=b''), 'image size 0x0'),
    'huge size': (bad_image(width=2**31, height=2**31), 'image size'),
    'short step': (bad_image(step=10), 'step 10 is shorter'),
    'long step': (bad_image(step=2**31), 'but 480 rows'),
    'short data': (bad_image(data=b'123'), 'image data has 3 bytes'),
    'zero K': (bad_info(k=np.zeros(9)), 'camera_info: K: fx=0'),
    'NaN in K': (bad_info(k=np.full(9, np.nan)), 'camera_info: K: fx=nan'),
    'K of another size': (bad_info(width=320, height=240), 'camera_info is for 320x240'),
    'unknown lens': (bad_info(distortion_model='mystery', d=[0.1]), "'mystery' is none of"),
    'too few coefficients': (bad_info(d=[0.1, 0.2]), '4 or 5 coefficients'),
    'infinite coefficient': (bad_info(d=[INF] * 5), 'not finite'),
    'no boxes': (bad_boxes([]), '0 detections'),
    'NaN boxes': (bad_boxes([[NAN] * 4] * 5), '0 detections'),
    'inverted boxes': (bad_boxes([[50, 50, 10, 10]] * 5), '0 detections'),
    'boxes outside': (bad_boxes([[900, 900, 950, 950]] * 5), '0 detections'),
    'infinite boxes': (bad_boxes([[-1e308, 0, 1e308, 9]] * 5), '0 detections'),
    'unknown classes': (bad_boxes([[10, 10, 50, 50]] * 5, 'zebra'), 'correspondence candidates'),
    'two boxes': (bad_boxes([[10, 10, 50, 50], [70, 10, 90, 50]]), '2 detections'),
    'thousands of boxes': (bad_boxes(np.random.default_rng(0).uniform(
        0, 200, (5000, 4)) + (0, 0, 200, 200)), 'refused'),
}


@pytest.mark.parametrize('name', BAD_FRAMES)
def test_bad_frames_are_named_and_the_node_lives_on(relocalizer, tester, name):
    change, reason = BAD_FRAMES[name]
    set_parameter(tester, 'time_budget_s', 1.0)
    frame = make_frame()
    change(*frame)
    answer = tester.relocalize(frame)
    assert not answer.success
    assert reason in answer.message, answer.message
    assert 'internal error' not in answer.message
    assert tester.relocalize(make_frame(stamp_s=101.0)).success


def test_detections_of_another_frame_do_not_pair(relocalizer, tester):
    set_parameter(tester, 'timeout_s', 1.0)
    image, info, _ = make_frame(stamp_s=1.0)
    answer = tester.relocalize((image, info, make_frame(stamp_s=2.0)[2]))
    assert 'stamps never match' in answer.message


def test_frames_out_of_order_and_time_going_back(relocalizer, tester):
    for stamp_s in (50.0, 10.0, 3600.0, 0.0):
        assert tester.relocalize(make_frame(stamp_s=stamp_s)).success
    newer, older = make_frame(stamp_s=80.0), make_frame(stamp_s=70.0)
    future = tester.ask()
    tester.wait_until_heard()
    tester.images.publish(newer[0])
    tester.images.publish(older[0])
    for message in (older[1], newer[1]):
        tester.infos.publish(message)
    tester.detections.publish(older[2])
    assert tester.answer(future).success
    tester.wait(lambda: tester.poses[-1].header.stamp.sec == 70, 'the older frame')


@pytest.mark.parametrize(('name', 'value', 'reason'), [
    ('algorithm', 'luck', 'is none of bf, ransac'),
    ('algorithm', 'b-prosc', "did you mean 'b-prosac'"),
    ('algorithm', 'prosac', "which matching 'class' has none of"),
    ('iterations', 0, 'must be'),
    ('iterations', 'many', 'must be of type int'),
    ('iou_threshold', NAN, 'must be'),
    ('timeout_s', -1.0, 'must be'),
    ('matching', 'clip', 'read-only'),
    ('map.frame_id', 'other', 'the map is read at start-up'),
    ('base_from_camera', [1.0] * 7, 'not of unit length'),
])
def test_bad_parameters_are_refused_at_run_time(relocalizer, tester, name, value, reason):
    result = set_parameter(tester, name, value)
    assert not result.successful
    if name != 'map.frame_id':
        assert reason in result.reason
    assert tester.relocalize(make_frame()).success


def test_parameters_change_at_run_time(relocalizer, tester):
    assert set_parameter(tester, 'min_inliers', 13).successful
    answer = tester.relocalize(make_frame())
    assert not answer.success
    assert '13 are needed' in answer.message
    assert set_parameter(tester, 'min_inliers', 4).successful
    assert tester.relocalize(make_frame()).success


@pytest.mark.parametrize(('parameters', 'reason'), [
    ({'matching': 'magic'}, "matching: 'magic' is none of class, clip, hybrid"),
    ({'algorithm': 'lcuk'}, "algorithm: 'lcuk' is none of"),
    ({'iterations': '0'}, 'iterations: 0 must be 1 to'),
    ({'iterations': 'x'}, 'iterations: must be of type int'),
    ({'map_file': '/nowhere/map.yaml'}, '/nowhere/map.yaml: No such file'),
    ({'map_file': "''"}, 'no map: set map_file'),
    ({'matching': 'hybrid', 'k': 13, 'clip_pretrained': '/nowhere.pt'}, 'nowhere.pt'),
    ({'matching': 'hybrid', 'clip_model': 'ViT-L-41', 'clip_pretrained': '/nowhere.pt'},
     'ViT-L-14'),
])
def test_bad_start_parameters_are_an_answer_not_an_end(start, tester, room_map, parameters,
                                                       reason):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', **parameters})
    process.wait_for_output('ERROR')
    tester.connect()
    answer = tester.answer(tester.ask())
    assert not answer.success
    assert reason in answer.message, answer.message
    assert process.alive
    assert 'Traceback' not in process.output()


def test_a_mended_parameter_mends_the_node(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'luck'})
    process.wait_for_output('ERROR')
    tester.connect()
    assert 'ros2 param set relocalizer algorithm' in tester.answer(tester.ask()).message
    assert set_parameter(tester, 'algorithm', 'bf').successful
    assert tester.relocalize(make_frame()).success


def test_a_mended_map_mends_the_node(start, tester, room_map, tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(room_map.read_text().replace('semi_axes', 'half_axes'))
    process = start('nodes.relocalizer', parameters={
        'map_file': path, 'matching': 'class', 'algorithm': 'bf'})
    process.wait_for_output('missing field: semi_axes')
    tester.connect()
    assert 'missing field: semi_axes' in tester.answer(tester.ask()).message
    path.write_text(room_map.read_text())
    assert tester.relocalize(make_frame()).success


def test_a_whole_number_serves_where_a_float_is_meant(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'timeout_s': 3,
        'itterations': 100})
    process.wait_for_output('ready after')
    tester.connect()
    request = GetParameters.Request(names=['timeout_s'])
    assert call(tester, GetParameters, '/relocalizer/get_parameters',
                request).values[0].double_value == 3.0
    assert "unknown parameter 'itterations' has no effect; did you mean 'iterations'?" in (
        process.output())


@pytest.mark.parametrize('signal_number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('asked', [False, True])
def test_signals_end_the_node(relocalizer, tester, signal_number, asked):
    if asked:
        tester.ask()
        tester.wait_until_heard()
    code, seconds = relocalizer.stop(signal_number)
    assert code == 0, relocalizer.output()
    assert seconds < 2.0
    assert 'Traceback' not in relocalizer.output()


def test_a_flood_of_images_is_survived_in_bounded_memory(start, tester, room_map):
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'mode': 'continuous'})
    process.wait_for_output('ready after')
    tester.connect()
    tester.wait_until_heard()
    image, info, detections = make_frame()
    before, start_time = process.memory_mib(), time.monotonic()
    for number in range(10_000):
        image.header.stamp.sec = number
        tester.images.publish(image)
    seconds = time.monotonic() - start_time
    peak = process.memory_mib('VmHWM')
    print(f'\n10,000 images of 0.9 MB in {seconds:.1f} s: {before:.0f} MiB before, at most '
          f'{peak:.0f} MiB')
    assert peak - before < 512
    assert tester.relocalize(make_frame(stamp_s=20_000.0)).success
