# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The test's node that exchanges messages with the nodes, and frames of the simulated room."""

import time
from contextlib import contextmanager

import numpy as np
from frames import header_of, messages_of
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from processes import PATIENCE_S, wait_for
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scene import CAMERA, make_room, see_room
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Empty, Trigger
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.messages import detections_from_msg
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.qos import LATCHED

PIXELS = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class TakingLocalizer:
    """Publishes each initial pose at once as its estimate, a millimetre off, while it is on."""

    def __init__(self, node):
        self.is_on, self._node = True, node
        self._start()

    def _start(self):
        self._publisher = self._node.create_publisher(
            PoseWithCovarianceStamped, 'amcl_pose', LATCHED)
        self._subscription = self._node.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', self._show, RELIABLE)

    def start_again(self):
        """Forget the pose, like a process that was killed and restarted."""
        self._node.destroy_publisher(self._publisher)
        self._node.destroy_subscription(self._subscription)
        self._start()

    def _show(self, pose):
        if self.is_on:
            pose.pose.pose.position.x += 1e-3
            self._publisher.publish(pose)


class Tester(Node):
    """Publishes frames, requests poses, and collects the relocalizer's messages."""

    __test__ = False  # no class of tests

    def __init__(self, namespace=''):
        super().__init__('tester', namespace=namespace)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.images = self.create_publisher(Image, 'image', RELIABLE)
        self.compressed = self.create_publisher(CompressedImage, 'image/compressed', RELIABLE)
        self.infos = self.create_publisher(CameraInfo, 'camera_info', RELIABLE)
        self.detections = self.create_publisher(Detection2DArray, 'detections', RELIABLE)
        self.poses, self.initial_poses, self.hypotheses = [], [], []
        self._forgotten_ns = 0
        for message, topic, kept in (
                (PoseWithCovarianceStamped, 'relocalizer/pose', self.poses),
                (PoseWithCovarianceStamped, 'initialpose', self.initial_poses),
                (PoseArray, 'relocalizer/hypotheses', self.hypotheses)):
            self.create_subscription(message, topic, self._keeper(kept), RELIABLE)
        self.localizer = TakingLocalizer(self)
        self._relocalize = self.create_client(Trigger, 'relocalizer/relocalize')
        self._reinitialize = self.create_client(Empty, 'reinitialize_global_localization')

    def _keeper(self, kept):
        def keep(msg, info):
            if info['source_timestamp'] > self._forgotten_ns:
                kept.append(msg)
        return keep

    def forget(self):
        """Drop all messages published before now, including those still in transit."""
        self._forgotten_ns = time.time_ns()
        for kept in (self.poses, self.initial_poses, self.hypotheses):
            kept.clear()

    def spin(self):
        self._executor.spin_once(timeout_sec=0.02)

    def wait(self, condition, what, patience_s=PATIENCE_S):
        wait_for(condition, what, patience_s, self.spin)

    def connect(self):
        """Wait until exactly one relocalizer publishes and its services are ready."""
        self.wait(lambda: len(self.get_publishers_info_by_topic('relocalizer/pose')) == 1,
                  'one relocalizer')
        self.wait(self._relocalize.service_is_ready, 'the service relocalize')
        self.wait(self._reinitialize.service_is_ready, 'the service reinitialize')

    def call(self, service_type, name, request):
        """Call a service; return the response."""
        client = self.create_client(service_type, name)
        self.wait(client.service_is_ready, name)
        answer = self.answer(client.call_async(request))
        self.destroy_client(client)
        return answer

    def trigger(self, name):
        """Call a service of the relocalizer that takes no arguments; return its answer."""
        return self.call(Trigger, f'relocalizer/{name}', Trigger.Request())

    def set_parameter(self, name, value):
        """Set a parameter of the relocalizer; return rclpy's result."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, 'relocalizer/set_parameters', request).results[0]

    @contextmanager
    def hearing_detections(self):
        """Collect the detections published meanwhile, the first for each stamp [ns]."""
        heard = {}
        subscription = self.create_subscription(
            Detection2DArray, 'detections',
            lambda msg: heard.setdefault(stamp_ns(msg.header.stamp), detections_from_msg(msg)),
            RELIABLE)
        try:
            yield heard
        finally:
            self.destroy_subscription(subscription)

    def listened_to(self):
        """Return the number of subscriptions to this node's topics."""
        return sum(publisher.get_subscription_count() for publisher in (
            self.images, self.compressed, self.infos, self.detections))

    def ask(self):
        """Send a request to relocalize; return its future."""
        return self._relocalize.call_async(Trigger.Request())

    def ask_reinitialize(self):
        return self._reinitialize.call_async(Empty.Request())

    def answer(self, future):
        self.wait(future.done, 'an answer')
        return future.result()

    def publish(self, messages):
        """Publish messages, each on the topic of its type."""
        for message in messages:
            {Image: self.images, CompressedImage: self.compressed, CameraInfo: self.infos,
             Detection2DArray: self.detections}[type(message)].publish(message)

    def feed_until(self, condition, frame, what='an answer'):
        """Publish a frame repeatedly, like a camera, until a condition is met."""
        def work():
            self.publish(frame)
            for _ in range(5):
                self.spin()
        wait_for(condition, what, work=work)

    def call_while(self, service_type, name, frame):
        """Call a service without arguments, and publish a frame until the answer arrives."""
        client = self.create_client(service_type, name)
        self.wait(client.service_is_ready, name)
        future = client.call_async(service_type.Request())
        self.feed_until(future.done, frame)
        self.destroy_client(client)
        return future.result()

    def relocalize(self, frame):
        """Send a request, publish a frame until the answer arrives, and return the answer."""
        future = self.ask()
        self.feed_until(future.done, frame)
        # else the frame may still arrive during the next request, and answer it; small messages
        # arrive at once, but are acknowledged up to three seconds later
        for publisher, patience_s in ((self.images, 1.0), (self.infos, 0.1),
                                      (self.detections, 0.1)):
            publisher.wait_for_all_acked(Duration(seconds=patience_s))
        return future.result()


def ask_until(ask, text, *given):
    """Request until the answer has a text: on a busy machine messages are sometimes late."""
    for _ in range(30):
        answer = ask(*given)
        if text in answer.message:
            return answer
    raise AssertionError(f'{text!r} in {answer.message}')


def transform_of(pose):
    p, q = pose.position, pose.orientation
    return transform_from_pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))


def make_frame(detections=None, stamp_s=100.0):
    """Return the messages of one frame of the simulated room, with the same stamp."""
    return messages_of(detections or see_room(make_room()),
                       header_of(round(stamp_s * 1e9), 'camera_optical_frame'), PIXELS)


def class_matching(room_map, **parameters):
    """Return parameters of a relocalizer that needs no network."""
    # the z axis of the room's map does not point up
    return {'map_file': room_map, 'matching': 'class', 'algorithm': 'bf',
            'tilt_deviation_deg': 0.0, **parameters}
