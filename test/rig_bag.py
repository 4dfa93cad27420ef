# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recording of the demo's rig: four cameras of a robot at six places."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagWriter, typestore
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.poses import mount_from_numbers
from cliploc_ros.offline.datasets.tum import read_tum
from demo.truth import read_objects

RIG = Path(__file__).resolve().parents[1] / 'demo/assets/rig'
#: By camera: x y z qx qy qz qw on the robot, whose origin is the front camera.
MOUNTS = json.loads((RIG / 'mounts.json').read_text())
TF = 'tf2_msgs/msg/TFMessage'


def write_rig_bag(path, cameras=tuple(MOUNTS), halved=()):
    """Write images, camera_info and ground truth of cameras, the robot's pose, and tf.

    The images of some cameras are halved.
    """
    robot = read_tum(RIG / 'front')
    poses = [(stamp, robot.pose_at(stamp)) for stamp in robot.stamps_ns]
    recorded = [*pose_messages(poses, '/robot'), *tf_messages(poses, child='robot')]
    for name in cameras:
        sequence, frame = read_tum(RIG / name), f'{name}_optical'
        camera = find_camera(None, sequence.folder)[0]
        if name in halved:
            camera = replace(camera, width=camera.width // 2, height=camera.height // 2,
                             **{key: getattr(camera, key) / 2 for key in ('fx', 'fy')},
                             **{key: (getattr(camera, key) + 0.5) / 2 - 0.5
                                for key in ('cx', 'cy')})
        recorded += tf_messages([(sequence.stamps_ns[0], mount_from_numbers(MOUNTS[name]))],
                                'robot', frame, '/tf_static')
        recorded += pose_messages([(stamp, sequence.pose_at(stamp))
                                   for stamp in sequence.stamps_ns], f'/{name}/ground_truth')
        for stamp, file in zip(sequence.stamps_ns, sequence.image_paths, strict=True):
            data = file.read_bytes()
            if name in halved:
                image = cv2.resize(cv2.imread(str(file)), (camera.width, camera.height),
                                   interpolation=cv2.INTER_AREA)
                data = cv2.imencode('.jpg', image)[1].tobytes()
            recorded += [
                (stamp, f'/{name}/image/compressed', bag_messages.COMPRESSED_IMAGE,
                 bag_messages.compressed_image_message(stamp, frame, data, 'jpeg')),
                (stamp, f'/{name}/camera_info', bag_messages.CAMERA_INFO,
                 bag_messages.camera_info_message(stamp, frame, camera))]
    return write_messages(path, recorded)


def transform(stamp, parent, child, pose):
    """Make a tf message with the pose of one coordinate frame in another."""
    field = bag_messages.pose_message(stamp, parent, pose)
    x, y, z = pose[:3, 3].tolist()
    return make(TF, transforms=[make(
        'geometry_msgs/msg/TransformStamped', header=field.header, child_frame_id=child,
        transform=make('geometry_msgs/msg/Transform', rotation=field.pose.orientation,
                       translation=make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)))])


def make(name, **fields):
    """Make a message of a type."""
    return typestore().types[name](**fields)


def depth_message(stamp, values, frame='camera'):
    """Make a depth image (h, w) of 16-bit counts or of floats."""
    return make('sensor_msgs/msg/Image', header=bag_messages.pose_message(
        stamp, frame, np.eye(4)).header, height=values.shape[0], width=values.shape[1],
        encoding='16UC1' if values.dtype == np.uint16 else '32FC1', is_bigendian=0,
        step=values.shape[1] * values.itemsize,
        data=np.frombuffer(values.tobytes(), dtype=np.uint8))


def camera_messages(at, pixels, camera, frame='camera', stamp=None):
    """Return an image and its camera_info for `write_messages`; `stamp`: other than the time."""
    stamp = at if stamp is None else stamp
    return [(at, '/image', bag_messages.IMAGE, bag_messages.image_message(stamp, frame, pixels)),
            (at, '/camera_info', bag_messages.CAMERA_INFO,
             bag_messages.camera_info_message(stamp, frame, camera))]


def pose_messages(poses, topic='/pose', late_ns=0):
    """Return poses of the camera, given with their times, for `write_messages`."""
    return [(at, topic, bag_messages.POSE, bag_messages.pose_message(at + late_ns, 'map', pose))
            for at, pose in poses]


def tf_messages(poses, parent='map', child='camera', topic='/tf'):
    """Return poses as transforms, given with their times, for `write_messages`."""
    return [(at, topic, TF, transform(at, parent, child, pose)) for at, pose in poses]


def odometry_message(at, odom_from_base, speed_m_s=0.5):
    """Return a message of /odom, of a robot that drives, for `write_messages`."""
    pose = bag_messages.pose_message(at, 'odom', odom_from_base)
    twist = make('geometry_msgs/msg/Twist', **{
        name: make('geometry_msgs/msg/Vector3', x=x, y=0.0, z=0.0)
        for name, x in (('linear', speed_m_s), ('angular', 0.0))})
    with_covariance = {name: make(f'geometry_msgs/msg/{name.title()}WithCovariance',
                                  covariance=np.zeros(36), **{name: value})
                       for name, value in (('pose', pose.pose), ('twist', twist))}
    return at, '/odom', bag_messages.ODOMETRY, make(
        bag_messages.ODOMETRY, header=pose.header, child_frame_id='base_footprint',
        **with_covariance)


def write_messages(path, recorded):
    """Write messages, given by time of recording [ns], topic, type and message, in any order."""
    with BagWriter(path) as bag:
        for topic, kind in dict.fromkeys((topic, kind) for _, topic, kind, _ in recorded):
            bag.add_topic(topic, kind)
        for at, topic, _, message in sorted(recorded, key=lambda one: one[0]):
            bag.write(topic, at, message)
    return path


def errors_of(map_file, world):
    """Return the distance of each landmark to the nearest true object of its class [m]."""
    found, objects = LandmarkMap.from_file(map_file), read_objects(world)
    return np.array([min(np.linalg.norm(item.center - center) for item in objects
                         if item.class_id == name)
                     for center, name in zip(found.centers, found.class_ids, strict=True)])
