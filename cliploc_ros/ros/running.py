# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Access to a running relocalizer from other programs: diagnostics and parameters."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMsg
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.validate_full_topic_name import validate_full_topic_name

from cliploc_ros.errors import CliplocError, OptionsError

#: Diagnostics are published once a second; a relocalizer that is silent for longer is dead.
SILENT_S = 5.0
_SPIN_S = 0.05


class RelocalizerStatus:
    """The state of one relocalizer by its diagnostics.

    Parameters
    ----------
    node : Node
        The subscribing node, which the caller spins.
    name : str
        The relocalizer's name with its namespace, as ``/robot/relocalizer``.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._name = name
        self._begun_at = time.monotonic()
        # Arrival of the last diagnostics (monotonic clock) [s], and their message.
        self._received_at, self._message = -math.inf, ''
        #: The values of the last diagnostics
        self.values: dict[str, str] = {}
        node.create_subscription(DiagnosticArray, '/diagnostics', self._take, 10)

    @property
    def silent_s(self) -> float:
        """Return the time since the last diagnostics [s]."""
        return time.monotonic() - max(self._received_at, self._begun_at)

    @property
    def time_limit_s(self) -> float:
        """Return the time limit of a request [s]; infinite if unknown."""
        return float(self.values.get('time limit [s]', math.inf))

    def has_reported_since(self, moment: float) -> bool:
        """Return whether it is active and has reported since `moment` (monotonic clock) [s]."""
        return self._received_at > moment and self.values.get('state') == 'active'

    def problem(self) -> str:
        """Return why the relocalizer cannot answer a request, and the remedy; empty if it can."""
        state, silent_s = self.values.get('state'), self.silent_s
        if state is None:
            return (f'{self._name} has sent no diagnostics yet: it is starting, or its '
                    '/diagnostics is remapped')
        if silent_s > SILENT_S:
            return (f'{self._name} has been silent for {silent_s:.0f} s: it has died, or its '
                    'machine is overloaded; restart it if it has died')
        if state != 'active':
            reason = self._message if self._message != state else \
                'it is loading, or its lifecycle manager must configure and activate it'
            return f'{self._name} is {state}: {reason}'
        return self.values.get('missing', '')

    def _take(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.hardware_id == self._name.lstrip('/'):
                self._received_at, self._message = time.monotonic(), status.message
                self.values = {value.key: value.value for value in status.values}


class NotRunningError(CliplocError):
    """The relocalizer is not running, or does not respond; the message says what to do."""


def check_name(name: str) -> None:
    """Raise OptionsError unless the value of `--relocalizer` is a valid name of a node."""
    try:
        validate_full_topic_name(expand_topic_name(name, 'node', '/'), is_service=True)
    except (InvalidServiceNameException, ValueError) as error:
        raise OptionsError(f'--relocalizer: {str(error).partition(", at ")[0]}') from error


def ask(node: Node, name: str, patience_s: float) -> tuple[RelocalizerStatus, list[Parameter]]:
    """Return state and parameters of a running relocalizer.

    Parameters
    ----------
    node : Node
        Makes the service calls. It must not be in another executor.
    name : str
        The relocalizer's name with its namespace.
    patience_s : float
        Time limit of discovery, and of each service call [s].

    Raises
    ------
    NotRunningError
        The relocalizer is not found, or does not respond.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    status, client = RelocalizerStatus(node, name), AsyncParameterClient(node, name)
    deadline = time.monotonic() + patience_s
    while not status.values or not client.services_are_ready():
        if time.monotonic() > deadline:
            raise NotRunningError(f'{name} is not running: start it, give its name with '
                                  '--relocalizer, or its parameters with --params-file')
        executor.spin_once(timeout_sec=_SPIN_S)
    listed = client.list_parameters()
    executor.spin_until_future_complete(listed, patience_s)
    names = listed.result().result.names if listed.done() else []
    got = client.get_parameters(names)
    executor.spin_until_future_complete(got, patience_s)
    if not names or not got.done():
        raise NotRunningError(f'{name} does not respond: restart it')
    return status, [Parameter.from_parameter_msg(ParameterMsg(name=parameter, value=value))
                    for parameter, value in zip(names, got.result().values, strict=True)]
