# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows what the nodes do on the wire, and nothing else."""

import xml.etree.ElementTree as ElementTree

import pytest
from processes import PROJECT
from tester import make_frame

pytestmark = pytest.mark.full

POLICY = PROJECT / 'config/security_policy.xml'
# Topics and services of tf2_ros and nav2_msgs, which are not installed on all test machines; those
# of floors are used where maps have nav2_map.
FOREIGN = {'/tf', '/tf_static', '/relocalizer/load_map', '/map', '/map_server/load_map',
           '/global_costmap/clear_entirely_global_costmap',
           '/local_costmap/clear_entirely_local_costmap'}
GRAPH = {('topics', 'publish'): 'get_publisher_names_and_types_by_node',
         ('topics', 'subscribe'): 'get_subscriber_names_and_types_by_node',
         ('services', 'reply'): 'get_service_names_and_types_by_node',
         ('services', 'request'): 'get_client_names_and_types_by_node'}
# Topics and services that SROS 2's permission to call an action implies.
CALL = {('topics', 'subscribe'): ('feedback', 'status'),
        ('services', 'request'): ('send_goal', 'cancel_goal', 'get_result')}


def allowed(node, kind, act):
    profile = ElementTree.parse(POLICY).find(f".//profile[@node='{node}']")
    actions = [action.text for action in profile.findall("actions[@call='ALLOW']/action")]
    return {entry.text for group in profile.findall(kind) if group.get(act) == 'ALLOW'
            for entry in group} | {f'{action}/_action/{name}' for action in actions
                                   for name in CALL.get((kind, act), ())}


def used(tester, node, kind, act):
    if node not in tester.get_node_names():  # these are reported later
        return set()
    return {name for name, _ in getattr(tester, GRAPH[kind, act])(node, '/')}


def check(tester, node, *absent):
    """Wait until a node uses all that its policy allows, except absent parts, and nothing else."""
    for kind, act in GRAPH:
        expected = allowed(node, kind, act) - FOREIGN - set(absent)
        tester.wait(lambda k=kind, a=act, e=expected: used(tester, node, k, a) - FOREIGN == e,
                    f'{node} to {act} {sorted(expected)}')


def test_the_relocalizer_does_what_its_policy_allows(own_relocalizer, tester):
    process = own_relocalizer(mode='continuous', gravity='imu', depth_transport='raw',
                              watch='amcl_pose')
    tester.feed_until(lambda: tester.poses, make_frame(), 'a pose')
    tester.ask()  # the node subscribes to odometry during a request
    check(tester, 'relocalizer', '/image/compressed', '/depth/compressedDepth', '/clock')
    process.stop()
    tester.wait(lambda: 'relocalizer' not in tester.get_node_names(), 'the end of the first node')
    own_relocalizer(image_transport='compressed', use_sim_time='true',
                    depth_transport='compressed')
    tester.ask()
    check(tester, 'relocalizer', '/image', '/depth', '/imu', '/relocalizer/localized',
          '/relocalizer/localization_state')


@pytest.mark.parametrize(('parameters', 'absent'), [
    ({}, ('/image/compressed', '/clock')),
    ({'image_transport': 'compressed', 'use_sim_time': 'true'}, ('/image',))])
def test_the_detector_does_what_its_policy_allows(start, tester, parameters, absent):
    weights = PROJECT / 'demo/assets/yolo.onnx'
    start('nodes.detector', parameters={'model': weights, **parameters}).wait_for_output(
        'ready after')
    with tester.hearing_detections():
        check(tester, 'detector', *absent)


@pytest.mark.needs('nav2_msgs')
def test_wake_up_does_what_its_policy_allows(start, tester):
    start('cli.wake_up', '--timeout', 60)
    check(tester, 'wake_up')
