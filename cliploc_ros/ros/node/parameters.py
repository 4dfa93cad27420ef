# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters declared once: each field of a dataclass is declaration, validation, documentation.

generate_parameter_library does the same at build time, but has no package outside of apt.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from cliploc_ros.errors import OptionsError, did_you_mean

Value = str | int | float | bool | list[float] | list[str]

# Parameters that rclpy declares itself, and the parameters of a map.
_FOREIGN_PREFIXES = ('map.', 'qos_overrides.')
_FOREIGN_NAMES = ('use_sim_time', 'start_type_description_service')


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of a node."""

    name: str
    #: Its type is the parameter's. A list of texts may have any length, and ROS knows the type of
    #: one that is not empty only: [''] stands for none.
    default: Value
    #: One sentence in prose.
    description: str
    #: SI symbol, px or ''.
    unit: str = ''
    #: Range of a number, ends included.
    low: float = -math.inf
    high: float = math.inf
    #: The allowed values of a text; empty allows any.
    choices: tuple[str, ...] = ()
    #: Read at start-up only. The others change at run time.
    read_only: bool = False
    #: A list of numbers may be as long as its default, or several times as long.
    repeats: bool = False

    @property
    def allowed(self) -> str:
        """Return the allowed values in words."""
        if self.choices:
            return ', '.join(self.choices)
        if isinstance(self.default, bool) or not isinstance(self.default, int | float):
            return ''
        if math.isinf(self.low) and math.isinf(self.high):
            return ''
        if math.isinf(self.high):
            return f'>= {self.low:g}'
        return f'{self.low:g} to {self.high:g}'

    @property
    def descriptor(self) -> ParameterDescriptor:
        """Return the descriptor that ROS's tools show."""
        unit = f' [{self.unit}]' if self.unit else ''
        descriptor = ParameterDescriptor(
            description=self.description + unit, additional_constraints=self.allowed,
            read_only=self.read_only)
        if isinstance(self.default, float) and math.isfinite(self.high - self.low):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(self.low), to_value=float(self.high))]
        elif type(self.default) is int and math.isfinite(self.high - self.low):
            descriptor.integer_range = [
                IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)]
        return descriptor

    def validated(self, value: Any) -> Value:
        """Return a value in the parameter's type; an integer becomes a float where that is meant.

        OptionsError: names the parameter and what it allows.
        """
        if isinstance(self.default, float) and type(value) is int:
            value = float(value)
        if isinstance(self.default, list) and isinstance(self.default[0], str):
            if not isinstance(value, list | tuple) \
                    or not all(isinstance(item, str) for item in value):
                raise OptionsError(f'{self.name}: must be a list of texts, not {value!r:.60}')
            value = list(value)
        elif isinstance(self.default, list):
            is_numbers = (
                not isinstance(value, str | bytes) and isinstance(value, Iterable)
                and all(type(item) in (int, float) and math.isfinite(item) for item in value))
            length = len(self.default)
            if not is_numbers or not (len(value) == length or (
                    self.repeats and value and len(value) % length == 0)):
                raise OptionsError(f'{self.name}: must be {length} finite numbers')
            value = [float(item) for item in value]
        if type(value) is not type(self.default):
            raise OptionsError(f'{self.name}: must be of type {type(self.default).__name__}, '
                               f'not {type(value).__name__} ({value!r:.60})')
        if self.choices and value not in self.choices:
            raise OptionsError(f"{self.name}: '{value}' is none of {self.allowed}"
                               f'{did_you_mean(str(value), self.choices)}')
        if isinstance(value, int | float) and not self.low <= value <= self.high:
            raise OptionsError(f'{self.name}: {value} must be {self.allowed}')
        return value


def parameter(default: Value, description: str, **row_fields: Any) -> Any:
    """Return the field of a parameter in a subclass of Parameters; see ParameterRow."""
    row = ParameterRow('', default, description, **row_fields)
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata={'row': row})
    return field(default=default, metadata={'row': row})


@dataclass(frozen=True)
class Parameters:
    """The values of a node's parameters; a subclass has a field for each, made by `parameter`."""

    autostart: bool = parameter(
        True, 'Configure and activate at start-up; false: wait for a lifecycle manager.',
        read_only=True)

    @classmethod
    def rows(cls) -> tuple[ParameterRow, ...]:
        """Return the declarations, own ones before inherited ones."""
        own_first = sorted(fields(cls), key=lambda one: one.name not in cls.__annotations__)
        return tuple(replace(one.metadata['row'], name=one.name) for one in own_first)

    def check(self) -> None:
        """Raise OptionsError where values do not fit together."""


class NodeParameters[P: Parameters]:
    """The parameters of one node: declared from a dataclass, validated at every change.

    An invalid value in a parameter file does not end the node: snapshot() raises it until the
    value is corrected.

    Parameters
    ----------
    node : Node
        Made with automatically_declare_parameters_from_overrides=True.
    others : type, optional
        Parameters of other nodes, which the same parameter file may hold.
    """

    def __init__(self, node: Node, kind: type[P], others: type[Parameters] = Parameters) -> None:
        self._node = node
        self._rows = {row.name: row for row in kind.rows()}
        self._problems: dict[str, str] = {}
        for row in self._rows.values():
            self._declare(row)
        known = {*self._rows, *(row.name for row in others.rows()), *_FOREIGN_NAMES}
        for name in node.get_parameters_by_prefix(''):  # most are typing errors
            if name not in known and not name.startswith(_FOREIGN_PREFIXES):
                node.get_logger().warning(f"unknown parameter '{name}' has no effect"
                                          f'{did_you_mean(name, self._rows)}')
        #: The values, which may not fit together. Replaced as a whole: a reader sees all of a
        #: change or none of it.
        self.values: P = kind(**{name: node.get_parameter(name).value for name in self._rows})
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._take)

    def snapshot(self) -> P:
        """Return the values.

        OptionsError: a value given at start-up is not allowed, or the values do not fit together.
        """
        if self._problems:
            raise OptionsError('parameter ' + '; '.join(self._problems.values()))
        values = self.values
        values.check()
        return values

    def _declare(self, row: ParameterRow) -> None:
        """Declare one parameter with its value from the command line or file, or its default."""
        value: Value = row.default
        if self._node.has_parameter(row.name):
            given = self._node.get_parameter(row.name).value
            self._node.undeclare_parameter(row.name)
            try:
                value = row.validated(given)
            except OptionsError as error:
                remedy = 'correct it and restart' if row.read_only else \
                    f'correct it with: ros2 param set {self._node.get_name()} {row.name} VALUE'
                self._problems[row.name] = f'{error}; {remedy}'
        self._node.declare_parameter(row.name, value, row.descriptor, ignore_override=True)

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Allow a change if all values are valid together; another callback may refuse it."""
        try:
            for parameter in parameters:
                if parameter.name.startswith('map.'):
                    raise OptionsError(f'{parameter.name}: the map is read at start-up')
            changed = self._validated(parameters)
            if not self._problems.keys() - changed.keys():
                replace(self.values, **changed).check()
        except OptionsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        """Use a change that every callback allowed."""
        changed = self._validated(parameters)
        self.values = replace(self.values, **changed)
        self._problems = {name: text for name, text in self._problems.items()
                          if name not in changed}

    def _validated(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Return the values of the parameters that the table declares, by name."""
        return {parameter.name: self._rows[parameter.name].validated(parameter.value)
                for parameter in parameters if parameter.name in self._rows}
