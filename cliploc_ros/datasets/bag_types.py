# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The types of recorded messages, without a sourced ROS. It imports little, for replay."""

from functools import cache
from importlib.resources import files
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cliploc_ros.errors import DatasetError

_VISION_MSGS = ('Point2D', 'Pose2D', 'BoundingBox2D', 'ObjectHypothesis',
                'ObjectHypothesisWithPose', 'Detection2D', 'Detection2DArray')


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy's common interfaces and the seven of vision_msgs.

    All callers share it: do not register types in it.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = files('cliploc_ros.datasets') / 'vision_msgs' / 'msg'
    for name in _VISION_MSGS:
        definition = (folder / f'{name}.msg').read_text(encoding='utf-8')
        store.register(get_types_from_msg(definition, f'vision_msgs/msg/{name}'))
    return store


def deserialize(data: bytes, msgtype: str, where: str) -> Any:
    """Return a message of its bytes; DatasetError: they are no such message."""
    try:
        return typestore().deserialize_cdr(data, msgtype)
    except Exception as error:  # the library raises what the bytes happen to cause
        raise DatasetError(f'{where}: a message is no {msgtype}: {error}') from error
