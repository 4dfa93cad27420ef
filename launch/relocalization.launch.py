# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start detector and relocalizer next to a camera driver."""

# ros2 launch cliploc_ros relocalization.launch.py map_file:=office.yaml \
#     image:=/camera/image_raw camera_info:=/camera/camera_info base_frame:=base_footprint
# With several cameras, each camera's topics are in its namespace: front/image_raw and so on.
# ros2 launch cliploc_ros relocalization.launch.py map_file:=office.yaml \
#     cameras:='[front, left, right]' image:=image_raw base_frame:=base_footprint

from pathlib import Path
from typing import List  # noqa: UP035  launch accepts only this form

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

# Launch files that include each other share their arguments. Therefore the names differ from those
# of Nav2's bringup, except for namespace, use_sim_time, autostart and log_level, which mean the
# same.

# Topics and services. Each is remapped by the argument with the same name.
NAMES = {
    'image': 'raw images of the camera driver; image/compressed is remapped accordingly',
    'camera_info': 'camera_info of the camera driver',
    'detections': 'detections from the detector to the relocalizer',
    'tags': 'tags from apriltag_ros, with tags_type:=apriltag_msgs',
    'depth': 'depth of an RGB-D camera, with depth_transport; depth/compressedDepth is remapped '
             'accordingly',
    'depth_camera_info': 'camera_info of a depth camera that is not registered to the image',
    'odom': 'odometry, which shows motion; without it the robot is assumed to be at rest',
    'imu': 'IMU, the source of the vertical with gravity:=imu',
    'initialpose': 'the pose that AMCL subscribes to',
    'amcl_pose': 'the pose of the localizer, with localizer_pose: amcl_pose; auto finds it',
    'request_nomotion_update': 'service of AMCL: process a scan while the robot is at rest',
    'reinitialize_global_localization': "service of the relocalizer that Nav2's behaviour tree "
                                        'calls; AMCL has a service of this name, too',
}
_OF_CAMERA = ('image', 'camera_info', 'detections', 'tags', 'depth', 'depth_camera_info')
# An argument that is not given takes its value from the file `parameters`, else its default.
DETECTOR_PARAMETERS = {
    'profile': 'detector and CLIP: accurate, balanced or fast',
    'model': 'weights of the detector',
    'vocabulary': 'classes of a YOLO-World or YOLOE: map, or a list of names',
    'map_file': 'map of objects: a path, or package://PACKAGE/PATH',
    'cameras': 'names of several cameras, which are the namespaces of their topics: [front, left]',
    'image_transport': 'raw or compressed',
    'autostart': 'false: a lifecycle manager configures and activates the nodes',
    'use_sim_time': 'true: use the time of /clock',
}
RELOCALIZER_PARAMETERS = {
    'profile': 'detector and CLIP: accurate, balanced or fast',
    'map_file': 'map of objects: a path, or package://PACKAGE/PATH',
    'map_files': 'maps of several floors, instead of map_file: [ground.yaml, first.yaml]',
    'keyframes_file': "layer of keyframes; 'auto': next to map_file",
    'base_frame': "the robot's frame, whose pose is published; empty: the camera's frame",
    'cameras': 'names of several cameras, which are the namespaces of their topics: [front, left]',
    'gravity': 'source of the vertical: none, base_frame or imu',
    'matching': 'hybrid, clip or class; class needs no CLIP',
    'mode': 'on_request or continuous',
    'watch': "source of the localizer's pose for the watch: none, tf or amcl_pose",
    'on_lost': 'report; or relocalize once the robot is at rest',
    'require_localizer': 'false: a request succeeds without AMCL, for ~/pose or publish_tf',
    'clip_model': 'open_clip architecture',
    'clip_pretrained': 'tag or file of the weights',
    'image_transport': 'raw or compressed',
    'depth_transport': 'none, raw or compressed',
    'autostart': 'false: a lifecycle manager configures and activates the nodes',
    'use_sim_time': 'true: use the time of /clock',
}
OTHERS = {
    'parameters': ('', 'parameter file of both nodes; the other arguments override it'),
    'namespace': ('', 'namespace of both nodes; use a different one for each robot or camera'),
    'tf': ('/tf', 'tf: use the transforms in the namespace, as Nav2 does for several robots'),
    'detector': ('true', 'false: another program publishes detections'),
    'log_level': ('info', 'debug, info, warn or error'),
}
_TRUTH_VALUES = ('autostart', 'require_localizer', 'use_sim_time')
_LISTS = ('map_files', 'cameras')


def generate_launch_description() -> LaunchDescription:
    """Return the description of both nodes, with the most common settings as arguments."""
    arguments = {name: (name, text) for name, text in NAMES.items()} | {
        name: ('', text) for name, text in (DETECTOR_PARAMETERS | RELOCALIZER_PARAMETERS).items()}
    declared = [DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in (arguments | OTHERS).items()]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes with the parameters that were given as arguments."""
    check_parameter_file(context.launch_configurations['parameters'])
    given = {name for name, value in context.launch_configurations.items() if value}
    cameras = yaml.safe_load(context.launch_configurations['cameras'] or '[]')
    topics = _topics(cameras)
    return [_node('detector', given & DETECTOR_PARAMETERS.keys(), given, topics,
                  condition=IfCondition(LaunchConfiguration('detector'))),
            _node('relocalizer', given & RELOCALIZER_PARAMETERS.keys(), given, topics)]


def _topics(cameras: list[str]) -> list[tuple[str, list]]:
    """Return the remappings of all topics; topics of cameras are in their namespaces."""
    remapped = []
    prefixes = [f'{camera}/' for camera in cameras] or ['']
    for name in NAMES:
        for prefix in prefixes if name in _OF_CAMERA else ['']:
            given = [prefix, LaunchConfiguration(name)]
            remapped.append((prefix + name, given))
            if name in ('image', 'depth'):
                transport = '/compressed' if name == 'image' else '/compressedDepth'
                remapped.append((prefix + name + transport, [*given, transport]))
    return remapped


def check_parameter_file(path: str) -> None:
    """Raise RuntimeError if a given file does not exist; launch_ros would only warn."""
    if path and not Path(path).is_file():
        raise RuntimeError(f"parameters:={path}: there is no such file ('~' is not expanded); "
                           'correct the path, or omit the argument to use the defaults')


def _type_of(parameter: str) -> type:
    if parameter in _LISTS:
        return List[str]  # noqa: UP006
    return bool if parameter in _TRUTH_VALUES else str


def _node(name: str, parameters: set[str], given: set[str], topics: list[tuple[str, list]],
          **keywords) -> Node:
    files = [ParameterFile(LaunchConfiguration('parameters'))] if 'parameters' in given else []
    changes = {parameter: ParameterValue(LaunchConfiguration(parameter),
                                         value_type=_type_of(parameter))
               for parameter in sorted(parameters)}
    tf = LaunchConfiguration('tf')
    return Node(
        package='cliploc_ros', executable=name, name=name, output='screen',
        namespace=LaunchConfiguration('namespace'),
        parameters=[*files, *([changes] if changes else [])],
        remappings=[*topics, ('/tf', tf), ('/tf_static', [tf, '_static'])],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')], **keywords)
