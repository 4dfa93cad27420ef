# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the running localizer has the camera at the stamp of an image."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import invert_transform, is_rigid
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import pose_from_msg, stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.odometry import OdometryPlace
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.time_jumps import stamp_problem
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

# Without odometry, a shown pose holds for this long (a guess): a robot drives half a metre in it.
_UNLINKED_NS = NS_PER_S // 2
# A localizer that hears scans shows its pose more often than this (AMCL: each .25 m).
_SILENT_WAY_M = 2.0


class NoLocalizerPoseError(CliplocError):
    """The localizer has no valid pose for an image; the message says what to do."""


class LaterError(NoLocalizerPoseError):
    """The next pose of the localizer may do."""


class _Anchor(NamedTuple):
    """Odometry's coordinate frame in the map (4, 4), by the pose that was shown at a stamp."""

    shown_ns: int
    run: int
    way_m: float
    map_from_odom: NDArray[np.float64]


class LocalizerPose:
    """Knows the localizer's pose by tf2, or by the topic localizer_pose and odometry since.

    All methods but `hear` and `forget` run in one thread.
    """

    def __init__(self, node: Node, robot: RobotStateSource) -> None:
        self._node = node
        self._robot = robot
        self.forget()

    def forget(self) -> None:
        """Forget what was heard: time jumped, or the node is inactive."""
        self._shown: PoseWithCovarianceStamped | None = None
        self._anchor: _Anchor | None = None

    def hear(self, shown: PoseWithCovarianceStamped) -> None:
        """Take in a pose that the localizer shows."""
        self._shown = shown

    def at(self, image: Header, state: RobotState, parameters: RelocalizerParameters,
           frame_ids: Sequence[str]) -> tuple[str, NDArray[np.float64]]:
        """Return the camera's pose (4, 4) at the stamp of an image, and the map it is in.

        `state` is the robot's at that stamp, `frame_ids` are those of the maps.

        NoLocalizerPoseError: there is none, or it is invalid. LaterError: it is too old.
        """
        frame_id, pose = self._by_tf(image, state, parameters, frame_ids) \
            if parameters.watch == 'tf' else self._by_topic(image, state, parameters)
        if frame_id not in frame_ids:
            raise NoLocalizerPoseError(f"the localizer's pose is in frame '{frame_id}', the map "
                                       f"in '{', '.join(frame_ids)}': correct the map's frame_id")
        return frame_id, pose

    def _by_tf(self, image: Header, state: RobotState, parameters: RelocalizerParameters,
               frame_ids: Sequence[str]) -> tuple[str, NDArray[np.float64]]:
        problem: NoTransformError | None = None
        for frame_id in frame_ids:
            try:
                map_from_base = self._robot.transforms.lookup(
                    frame_id, parameters.base_frame or image.frame_id, image.stamp,
                    parameters.tf_timeout_s, 'start the localizer (AMCL)')
            except NoTransformError as error:
                problem = problem or error
                continue
            if not is_rigid(map_from_base):
                raise NoLocalizerPoseError(f"the transform from '{parameters.base_frame}' to "
                                           f"'{frame_id}' is no pose: see the localizer's log")
            return frame_id, map_from_base @ invert_transform(state.camera_from_base)
        raise NoLocalizerPoseError(str(problem)) from problem

    def _by_topic(self, image: Header, state: RobotState, parameters: RelocalizerParameters
                  ) -> tuple[str, NDArray[np.float64]]:
        topic = self._node.resolve_topic_name(parameters.localizer_pose)
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            raise NoLocalizerPoseError(f'nobody publishes {topic}: start the localizer (AMCL), or '
                                       'name the topic of its pose by localizer_pose')
        if len(publishers) > 1:
            names = ', '.join(sorted(one.node_name for one in publishers))
            raise NoLocalizerPoseError(f'{len(publishers)} publishers of {topic} ({names}): stop '
                                       'all but one')
        shown = self._shown
        if shown is None:
            raise NoLocalizerPoseError(f'no pose heard on {topic} yet: AMCL shows one once the '
                                       'robot drives; watch: tf need not wait')
        pose, place = _pose_of(shown, topic), state.place
        shown_ns, frame_id = stamp_ns(shown.header.stamp), shown.header.frame_id.lstrip('/')
        if place is None:
            since_ns = stamp_ns(image.stamp) - shown_ns
            if abs(since_ns) > _UNLINKED_NS:
                raise NoLocalizerPoseError(
                    f'{topic} is {since_ns / NS_PER_S:.1f} s older than the image, and odom does '
                    'not tell the way since: publish odom')
            return frame_id, pose @ invert_transform(state.camera_from_base)
        anchor = self._anchored(shown, pose, image, place, parameters, topic)
        if place.way_m - anchor.way_m > _SILENT_WAY_M:
            raise NoLocalizerPoseError(
                f'{topic} is silent for {place.way_m - anchor.way_m:.1f} m of way: see whether '
                'the localizer is active and hears scans')
        return frame_id, anchor.map_from_odom @ place.odom_from_frame

    def _anchored(self, shown: PoseWithCovarianceStamped, pose: NDArray[np.float64],
                  image: Header, place: OdometryPlace, parameters: RelocalizerParameters,
                  topic: str) -> _Anchor:
        """Return odometry's coordinate frame in the map, by the newest pose that was shown."""
        shown_ns, anchor = stamp_ns(shown.header.stamp), self._anchor
        if anchor is None or (anchor.shown_ns, anchor.run) != (shown_ns, place.run):
            then = self._robot.at(Header(stamp=shown.header.stamp, frame_id=image.frame_id),
                                  parameters)
            if then.place is None or then.place.run != place.run:
                raise LaterError(f'odom does not tell the way since {topic} was published: wait '
                                 'for the next pose')
            map_from_camera = pose @ invert_transform(then.camera_from_base)
            anchor = self._anchor = _Anchor(
                shown_ns, place.run, then.place.way_m,
                map_from_camera @ invert_transform(then.place.odom_from_frame))
        return anchor


def _pose_of(shown: PoseWithCovarianceStamped, topic: str) -> NDArray[np.float64]:
    """Return a shown pose (4, 4). NoLocalizerPoseError: it is invalid."""
    if why := stamp_problem(shown.header.stamp):
        raise NoLocalizerPoseError(f'the stamp of {topic} {why}: the localizer '
                                   'must stamp its pose')
    pose = pose_from_msg(shown.pose.pose)
    if pose is None:
        raise NoLocalizerPoseError(f'{topic} shows a pose with NaN or a quaternion that is not '
                                   "of length 1: see the localizer's log")
    return pose
