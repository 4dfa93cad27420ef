# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Message types for reading and writing recordings without a sourced ROS."""

from functools import cache
from importlib.resources import files

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

VISION_MSGS = (
    'Point2D',
    'Pose2D',
    'BoundingBox2D',
    'ObjectHypothesis',
    'ObjectHypothesisWithPose',
    'Detection2D',
    'Detection2DArray',
)


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy's common interfaces and the seven of vision_msgs.

    Returns
    -------
    Typestore
        Shared by all callers: do not register types in it.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = files('cliploc_ros.datasets') / 'vision_msgs' / 'msg'
    for name in VISION_MSGS:
        definition = (folder / f'{name}.msg').read_text(encoding='utf-8')
        store.register(get_types_from_msg(definition, f'vision_msgs/msg/{name}'))
    return store
