# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows what the nodes do on the wire, and nothing else."""

import shutil
import subprocess
import xml.etree.ElementTree as ElementTree

from conftest import PROJECT, make_frame

POLICY = PROJECT / 'config/security_policy.xml'
# What only other parameters, or tf2_ros, bring.
OPTIONAL = {'/image/compressed', '/clock', '/tf', '/tf_static'}
GRAPH = {('topics', 'publish'): 'get_publisher_names_and_types_by_node',
         ('topics', 'subscribe'): 'get_subscriber_names_and_types_by_node',
         ('services', 'reply'): 'get_service_names_and_types_by_node',
         ('services', 'request'): 'get_client_names_and_types_by_node'}


def allowed(node, kind, act):
    profile = ElementTree.parse(POLICY).find(f".//profile[@node='{node}']")
    return {entry.text for group in profile.findall(kind) if group.get(act) == 'ALLOW'
            for entry in group}


def used(tester, node, kind, act):
    return {name for name, _ in getattr(tester, GRAPH[kind, act])(node, '/')}


def check(tester, node):
    for kind, act in GRAPH:
        expected = allowed(node, kind, act)
        tester.wait(lambda k=kind, a=act, e=expected: e - used(tester, node, k, a) <= OPTIONAL,
                    f'{node} to {act} {sorted(expected)}')
        assert used(tester, node, kind, act) <= expected


def test_the_relocalizer_does_what_its_policy_allows(own_relocalizer, tester):
    own_relocalizer(mode='continuous', gravity='imu')
    tester.feed_until(lambda: tester.poses, make_frame(), 'a pose')
    tester.ask()  # odometry is listened to during a request
    check(tester, 'relocalizer')


def test_the_detector_does_what_its_policy_allows(start, tester):
    start('nodes.detector', parameters={'model': PROJECT / 'cliploc_ros/demo/assets/yolo.pt'}
          ).wait_for_output('ready after')
    with tester.hearing_detections():
        check(tester, 'detector')


def test_the_tools_take_the_policy(tmp_path):
    """Runs where ros2 security is installed."""
    if shutil.which('ros2') is None:
        print('\nros2 security is not installed here: the policy was compared with the graph only')
        assert {'/cliploc_ros/detector', '/cliploc_ros/relocalizer'} == {
            enclave.get('path') for enclave in ElementTree.parse(POLICY).iter('enclave')}
        return
    keystore = tmp_path / 'keys'
    for command in (['create_keystore', keystore],
                    ['create_enclave', keystore, '/cliploc_ros/relocalizer'],
                    ['create_permission', keystore, '/cliploc_ros/relocalizer', POLICY]):
        subprocess.run(['ros2', 'security', *map(str, command)], check=True, timeout=60)
