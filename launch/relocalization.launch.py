# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detector and relocalizer beside a camera driver."""

# ros2 launch cliploc_ros relocalization.launch.py map:=office.yaml \
#     image:=/camera/image_raw camera_info:=/camera/camera_info base_frame:=base_footprint

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

# Topics and services, each remapped by the argument of its name.
NAMES = {
    'image': "the camera driver's topic; image/compressed hangs below it",
    'camera_info': "the camera driver's topic",
    'detections': 'from the detector to the relocalizer',
    'odom': 'tells whether the robot moves; without it, it is taken to stand',
    'imu': 'with gravity:=imu',
    'initialpose': 'what AMCL listens to',
    'request_nomotion_update': 'what AMCL serves',
    'reinitialize_global_localization': "what Nav2's behaviour tree calls",
}
# Where one is not given the file `parameters` decides, and then the node's own default.
DETECTOR_PARAMETERS = {
    'model': 'YOLO weights',
    'image_transport': 'raw or compressed',
    'autostart': 'false: a lifecycle manager configures and activates',
    'use_sim_time': 'true: take the time from /clock',
}
RELOCALIZER_PARAMETERS = {
    'map': 'map file, the parameter map_file',
    'base_frame': "frame whose pose is published; else the camera's",
    'gravity': 'what tells the vertical: none, base_frame or imu',
    'matching': 'hybrid, clip or class; class needs no CLIP',
    'mode': 'on_request or continuous',
    'clip_model': 'open_clip architecture',
    'clip_pretrained': 'tag or file',
    'image_transport': 'raw or compressed',
    'autostart': 'false: a lifecycle manager configures and activates',
    'use_sim_time': 'true: take the time from /clock',
}
OTHERS = {
    'parameters': ('', "file of the nodes' parameters; arguments that are given go before it"),
    'namespace': ('', 'of both nodes: one for each robot, and for each camera'),
    'tf': ('/tf', 'tf: in the namespace, as Nav2 has it for one robot of several'),
    'detector': ('true', 'false: somebody else publishes detections'),
    'log_level': ('info', 'debug, info, warn or error'),
}
_TRUTH_VALUES = ('autostart', 'use_sim_time')


def generate_launch_description() -> LaunchDescription:
    """Return both nodes, with what people most often set as arguments."""
    arguments = {name: (name, text) for name, text in NAMES.items()} | {
        name: ('', text) for name, text in (DETECTOR_PARAMETERS | RELOCALIZER_PARAMETERS).items()}
    declared = [DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in (arguments | OTHERS).items()]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes, with those parameters that are given."""
    given = {name for name, value in context.launch_configurations.items() if value}
    return [_node('detector', given & DETECTOR_PARAMETERS.keys(), given,
                  condition=IfCondition(LaunchConfiguration('detector'))),
            _node('relocalizer', given & RELOCALIZER_PARAMETERS.keys(), given)]


def _node(name: str, parameters: set[str], given: set[str], **keywords) -> Node:
    files = [ParameterFile(LaunchConfiguration('parameters'))] if 'parameters' in given else []
    changes = {'map_file' if one == 'map' else one: ParameterValue(
        LaunchConfiguration(one), value_type=bool if one in _TRUTH_VALUES else str)
        for one in sorted(parameters)}
    tf, image = LaunchConfiguration('tf'), LaunchConfiguration('image')
    return Node(
        package='cliploc_ros', executable=name, name=name, output='screen',
        namespace=LaunchConfiguration('namespace'),
        parameters=[*files, *([changes] if changes else [])],
        remappings=[*((topic, LaunchConfiguration(topic)) for topic in NAMES),
                    ('image/compressed', [image, '/compressed']),
                    ('/tf', tf), ('/tf_static', [tf, '_static'])],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')], **keywords)
