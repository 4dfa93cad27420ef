# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kidnap a driving robot: the watch detects it, the robot stops, and is relocalized."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header, String
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    pose_error,
    quaternion_from_transform,
    transform_from_pose,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.watch.watch import WatchState
from cliploc_ros.messages import detections_from_msg
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.poses import slerp
from cliploc_ros.offline.datasets.tum import read_tum
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import (
    pose_from_msg,
    pose_to_msg,
    pose_with_covariance_msg,
    stamp_ns,
)
from cliploc_ros.ros.visualization import image_to_msg
from demo.pictures import Moment, Step, draw_kidnapped
from demo.processes import DemoError, own_ros_domain
from demo.run import DemoOptions, nodes, prepare

PICTURE = 'kidnapped.png'
_SPEED_M_S, _TICK_S = 0.3, 0.05
# Periods of the images of a standing robot, and of the localizer's pose.
_IMAGE_PERIOD_S, _POSE_PERIOD_S = 0.25, 0.25
_PATIENCE_S = 60.0
# The robot drives on for this number of looks after the watch reports it lost. No pose may be
# published or delivered meanwhile.
_LOOKS_LOST = 2
_STANDS_ON_S = 2.0
_FRAME = 'camera'
# Images of the walk that the robot drives backwards, and of the other walk, 3 m away, to which it
# is moved.
_BEFORE, _AFTER = slice(8, 1, -1), slice(1, 14)


@dataclass(frozen=True)
class View:
    """An image of the room, and the pose of its camera (4, 4)."""

    file: Path
    map_from_camera: NDArray[np.float64]


class KidnappedRobot(Node):
    """Publishes views, odometry and the pose of a localizer that follows odometry, as AMCL does.

    ``check`` is called in each tick; it raises an error if a node has ended.
    """

    def __init__(self, camera: Camera, frame_id: str, check: Callable[[], None]) -> None:
        super().__init__('robot')
        self._camera, self._frame_id, self._check = camera, frame_id, check
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._image = self.create_publisher(Image, 'image', qos.POSE)
        self._info = self.create_publisher(CameraInfo, 'camera_info', qos.POSE)
        self._odom = self.create_publisher(Odometry, 'odom', qos.POSE)
        self._shown = self.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', qos.LATCHED)
        self.create_subscription(PoseWithCovarianceStamped, 'initialpose', self._take, qos.POSE)
        self.create_subscription(PoseWithCovarianceStamped, 'relocalizer/pose', self._on_pose,
                                 qos.POSE)
        self.create_subscription(String, 'relocalizer/localization_state', self._on_state,
                                 qos.LATCHED)
        self.create_subscription(Detection2DArray, 'detections', self._on_detections,
                                 qos.DETECTIONS_OUT)
        self._truth = self._odom_from_camera = self._map_from_odom = np.eye(4)
        self._show_at = 0.0
        self.began_at, self.looks, self.state = time.monotonic(), 0, ''
        #: Time [s] and number of looks when the watch first reported it lost; None before.
        self.lost: tuple[float, int] | None = None
        #: Arrival times of the relocalizer's poses, and of those delivered to the localizer [s].
        self.relocalized_s: list[float] = []
        self.delivered_s: list[float] = []
        self.moments: list[Moment] = []
        #: The newest view with detections, and these detections.
        self.seen: tuple[View, Detections] | None = None
        self._views: dict[int, View] = {}

    @property
    def now_s(self) -> float:
        """Return the time since the start [s]."""
        return time.monotonic() - self.began_at

    @property
    def error_m(self) -> float:
        """Return the position error of the localizer [m]."""
        return pose_error(self._map_from_odom @ self._odom_from_camera, self._truth)[0]

    def put(self, view: View) -> None:
        """Put the robot down at a view; neither odometry nor the localizer notices."""
        self._truth = view.map_from_camera

    def begin(self, view: View) -> None:
        """Start at a view, with a localizer that knows the true pose."""
        self.put(view)
        self._map_from_odom = view.map_from_camera

    def drive(self, views: Sequence[View]) -> Iterator[None]:
        """Drive from the first view through the others; yield at each view after the first."""
        for last, view in pairwise(views):
            step = invert_transform(last.map_from_camera) @ view.map_from_camera
            way_m = float(np.linalg.norm(step[:3, 3]))
            ticks = max(1, round(way_m / _SPEED_M_S / _TICK_S))
            begin = self._odom_from_camera
            for tick in range(1, ticks + 1):
                self._truth = _between(last.map_from_camera, view.map_from_camera, tick / ticks)
                self._odom_from_camera = begin @ invert_transform(
                    last.map_from_camera) @ self._truth
                self._pass(view if tick == ticks else None)
            yield

    def stand(self, view: View, until: Callable[[], bool], what: str) -> None:
        """Stand at a view until a condition holds. DemoError: time-out."""
        end, image_at = self.now_s + _PATIENCE_S, 0.0
        while not until():
            if self.now_s > end:
                raise DemoError(f'waited {_PATIENCE_S:g} s for {what}')
            is_due = self.now_s >= image_at
            if is_due:
                image_at = self.now_s + _IMAGE_PERIOD_S
            self._pass(view if is_due else None)

    def _pass(self, view: View | None) -> None:
        """Run for one tick: publish odometry and pose, and an image if there is a view."""
        self._check()
        end = time.monotonic() + _TICK_S
        stamp = self.get_clock().now()
        odometry = Odometry(header=Header(frame_id='odom', stamp=stamp.to_msg()),
                            child_frame_id=_FRAME)
        odometry.pose.pose = pose_to_msg(self._odom_from_camera)
        self._odom.publish(odometry)
        localized = self._map_from_odom @ self._odom_from_camera
        if self.now_s >= self._show_at:
            self._show_at = self.now_s + _POSE_PERIOD_S
            self._shown.publish(pose_with_covariance_msg(
                Header(frame_id=self._frame_id, stamp=stamp.to_msg()), localized,
                0.01 * np.eye(6)))
        if view is not None:
            self._take_image(view, Header(frame_id=_FRAME, stamp=stamp.to_msg()))
        self.moments.append(Moment(self.now_s, self._truth, localized, self.state))
        while (left_s := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left_s)

    def _take_image(self, view: View, header: Header) -> None:
        camera, pixels = self._camera, cv2.imread(str(view.file))
        if pixels is None:
            raise DemoError(f'{view.file} is not an image: choose another folder with --assets')
        self._views[stamp_ns(header.stamp)] = view
        self._image.publish(image_to_msg(np.asarray(cv2.cvtColor(
            pixels, cv2.COLOR_BGR2RGB), dtype=np.uint8), header))
        self._info.publish(CameraInfo(
            header=header, width=camera.width, height=camera.height, k=camera.matrix.ravel(),
            distortion_model='plumb_bob', d=[0.0] * 5,
            p=np.c_[camera.matrix, np.zeros(3)].ravel()))

    def _take(self, msg: PoseWithCovarianceStamped) -> None:
        """Adopt a pose, as AMCL does at rest."""
        pose = pose_from_msg(msg.pose.pose)
        assert pose is not None
        self._map_from_odom = pose @ invert_transform(self._odom_from_camera)
        self._show_at = 0.0
        self.delivered_s.append(self.now_s)

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        self.relocalized_s.append(self.now_s)

    def _on_state(self, msg: String) -> None:
        if (self.state, msg.data) != (WatchState.LOST, WatchState.UNCERTAIN):
            self.looks += 1  # otherwise the watch has restarted with the delivered pose
        self.state = msg.data
        if self.state == WatchState.LOST and self.lost is None:
            self.lost = self.now_s, self.looks

    def _on_detections(self, msg: Detection2DArray) -> None:
        view = self._views.get(stamp_ns(msg.header.stamp))
        if view is not None and self.state != WatchState.LOST:
            self.seen = view, detections_from_msg(msg)


def run_kidnapped(options: DemoOptions) -> list[Step]:
    """Kidnap the robot, print what happens, and draw it; return the steps.

    CliplocError: assets are missing, the nodes do not run, or the robot is not relocalized.
    """
    prepare(options)
    landmark_map = LandmarkMap.from_file(options.map_file)
    walks = [read_tum(options.assets / name) for name in ('sequence', 'mapping')]
    before, after = ([View(walk.image_paths[row], pose) for row in range(len(walk))[chosen]
                      if (pose := walk.pose_at(walk.stamps_ns[row])) is not None]
                     for walk, chosen in zip(walks, (_BEFORE, _AFTER), strict=True))
    camera = find_camera(None, walks[0].folder)[0]
    with own_ros_domain() as domain, nodes(options, domain) as check:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        robot = KidnappedRobot(camera, landmark_map.frame_id, check)
        try:
            steps = _kidnap(robot, before, after)
        finally:
            robot.destroy_node()
            rclpy.try_shutdown()
    picture = options.out / PICTURE
    assert robot.seen is not None
    view, detections = robot.seen
    draw_kidnapped(view.file, camera, detections, landmark_map, robot.moments, steps, picture)
    print(f'picture: {picture.resolve()}', flush=True)
    return steps


def _kidnap(robot: KidnappedRobot, before: Sequence[View], after: Sequence[View]) -> list[Step]:
    """Let the robot drive, move it elsewhere, and wait until its localizer is correct again."""
    steps: list[Step] = []
    moved_s, first = 0.0, 0

    def tell(text: str, at_s: float | None = None, looks: int | None = None) -> None:
        step = Step(robot.now_s if at_s is None else at_s,
                    robot.looks if looks is None else looks, text)
        steps.append(step)
        when = f'{step.time_s - moved_s:5.1f} s {step.looks - first:3d} looks' \
            if moved_s else 'before'
        print(f'{when:>17}: {text}', flush=True)

    robot.begin(before[0])
    for _ in robot.drive(before):
        pass
    robot.stand(before[-1], lambda: robot.state == WatchState.LOCALIZED, 'the watch to agree')
    tell(f'the watch agrees with the localizer, {robot.error_m:.2f} m from the truth')
    moved_s, first = robot.now_s, robot.looks
    robot.put(after[0])
    tell(f'moved by {robot.error_m:.2f} m; odometry and localizer do not notice')
    way = robot.drive(after)
    last = next((view for view, _ in zip(after[1:], way, strict=False)
                 if robot.lost and robot.looks >= robot.lost[1] + _LOOKS_LOST), None)
    if robot.lost is None or last is None:
        raise DemoError('the watch did not report the robot lost before the recording ended')
    tell('the watch reports the robot lost; it drives on', *robot.lost)
    stopped_s = robot.now_s
    tell('the robot stops')
    if robot.relocalized_s or robot.delivered_s:
        raise DemoError('a pose arrived while the robot was driving')
    robot.stand(last, lambda: bool(robot.delivered_s), 'a pose to be delivered')
    tell(f'relocalized, {robot.relocalized_s[0] - stopped_s:.1f} s after it stopped',
         robot.relocalized_s[0])
    tell(f'delivered: {robot.error_m:.2f} m from the truth', robot.delivered_s[0])
    robot.stand(last, lambda: robot.state == WatchState.LOCALIZED, 'the watch to agree')
    tell('the watch agrees again')
    end_s = robot.now_s + _STANDS_ON_S
    robot.stand(last, lambda: robot.now_s > end_s, 'the end')
    return steps


def _between(start: NDArray[np.float64], end: NDArray[np.float64], share: float
             ) -> NDArray[np.float64]:
    """Interpolate between two poses (4, 4)."""
    quat = slerp(quaternion_from_transform(start), quaternion_from_transform(end), share)
    place = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
    return transform_from_pose(place, quat)
