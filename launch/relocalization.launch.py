# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detector and relocalizer beside a camera driver."""

# ros2 launch cliploc_ros relocalization.launch.py map:=office.yaml \
#     image:=/camera/image_raw camera_info:=/camera/camera_info base_frame:=base_footprint

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    'map': ('', 'map file'),
    'image': ('image', "the camera driver's topic; image/compressed hangs below it"),
    'camera_info': ('camera_info', "the camera driver's topic"),
    'image_transport': ('raw', 'raw or compressed'),
    'namespace': ('', 'of both nodes; one for each camera'),
    'base_frame': ('', "frame whose pose is published; empty: the camera's"),
    'gravity': ('none', 'what tells the vertical: none, base_frame or imu'),
    'matching': ('hybrid', 'hybrid, clip or class; class needs no CLIP'),
    'mode': ('on_request', 'on_request or continuous'),
    'model': ('yolov8x.pt', 'YOLO weights'),
    'clip_model': ('ViT-L-14', 'open_clip architecture'),
    'clip_pretrained': ('openai', 'tag or file'),
    'detector': ('true', 'false: somebody else publishes detections'),
    'autostart': ('true', 'false: a lifecycle manager configures and activates'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'log_level': ('info', 'debug, info, warn or error'),
}
_DETECTOR_ARGUMENTS = ('model', 'image_transport', 'autostart', 'use_sim_time')
_RELOCALIZER_ARGUMENTS = ('image_transport', 'base_frame', 'gravity', 'matching', 'mode',
                          'clip_model', 'clip_pretrained', 'autostart', 'use_sim_time')
_TRUTH_VALUES = ('autostart', 'use_sim_time')


def generate_launch_description() -> LaunchDescription:
    """Return both nodes, with what people most often set as arguments."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}

    def node(executable: str, names: tuple[str, ...], extra: dict | None = None, **keywords):
        defaults = PathJoinSubstitution(
            [FindPackageShare('cliploc_ros'), 'config', f'{executable}.yaml'])
        changes = {name: ParameterValue(given[name],
                                        value_type=bool if name in _TRUTH_VALUES else str)
                   for name in names} | (extra or {})
        return Node(
            package='cliploc_ros', executable=executable, name=executable,
            namespace=given['namespace'], output='screen',
            parameters=[ParameterFile(defaults), changes],
            remappings=[('image', given['image']),
                        ('image/compressed', [given['image'], '/compressed']),
                        ('camera_info', given['camera_info'])],
            ros_arguments=['--log-level', given['log_level']], **keywords)

    declared = [DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()]
    return LaunchDescription([
        *declared,
        node('detector', _DETECTOR_ARGUMENTS, condition=IfCondition(given['detector'])),
        node('relocalizer', _RELOCALIZER_ARGUMENTS,
             {'map_file': ParameterValue(given['map'], value_type=str)}),
    ])
