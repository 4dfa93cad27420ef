# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node parameters as fields of a dataclass: declared, validated and documented in one place.

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

# Parameters that rclpy declares, and the parameters of a map.
_FOREIGN_PREFIXES = ('map.', 'qos_overrides.')
_FOREIGN_NAMES = ('use_sim_time', 'start_type_description_service')


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of a node."""

    name: str
    #: Its type is that of the parameter. A list of texts may have any length. Because ROS does not
    #: know the type of an empty list, [''] stands for it.
    default: Value
    #: One sentence.
    description: str
    #: SI symbol, px or ''.
    unit: str = ''
    #: Range of a number, or of each number of a list, including both ends; both are infinite, or
    #: neither.
    low: float = -math.inf
    high: float = math.inf
    #: The allowed values of a text; empty: any.
    choices: tuple[str, ...] = ()
    #: Read only at start-up. Other parameters can change at run time.
    read_only: bool = False
    #: Whether the length of a list may be a multiple of that of its default.
    repeats: bool = False

    @property
    def allowed(self) -> str:
        """Return a description of the allowed values."""
        if self.choices:
            return ', '.join(self.choices)
        return '' if math.isinf(self.high) else f'{self.low:g} to {self.high:g}'

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
        """Return a value in the parameter's type; an integer is converted to float if needed.

        OptionsError: the value is invalid; the message names the parameter and allowed values.
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
            if not all(self.low <= item <= self.high for item in value):
                raise OptionsError(f'{self.name}: {value} must be {self.allowed}')
        if type(value) is not type(self.default):
            raise OptionsError(f'{self.name}: must be of type {type(self.default).__name__}, '
                               f'not {type(value).__name__} ({value!r:.60})')
        if self.choices and value not in self.choices:
            raise OptionsError(f"{self.name}: '{value}' is not one of {self.allowed}"
                               f'{did_you_mean(str(value), self.choices)}')
        if isinstance(value, int | float) and not self.low <= value <= self.high:
            raise OptionsError(f'{self.name}: {value} must be {self.allowed}')
        return value


def parameter(default: Value, description: str, **row_fields: Any) -> Any:
    """Return the field of a parameter for a subclass of Parameters; see ParameterRow."""
    row = ParameterRow('', default, description, **row_fields)
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata={'row': row})
    return field(default=default, metadata={'row': row})


@dataclass(frozen=True)
class Parameters:
    """The values of a node's parameters. Subclasses add fields made by `parameter`."""

    autostart: bool = parameter(
        True, 'Configure and activate at start-up; false: wait for a lifecycle manager.',
        read_only=True)

    @classmethod
    def rows(cls) -> tuple[ParameterRow, ...]:
        """Return the declarations, those of this class before inherited declarations."""
        own_first = sorted(fields(cls), key=lambda own: own.name not in cls.__annotations__)
        return tuple(replace(own.metadata['row'], name=own.name) for own in own_first)

    def check(self) -> None:
        """Raise OptionsError if values contradict each other."""


class NodeParameters[P: Parameters]:
    """The parameters of one node, declared from a dataclass and validated at every change.

    An invalid value in a parameter file does not end the node: snapshot() raises an error until
    the value is corrected.

    Parameters
    ----------
    node : Node
        Made with automatically_declare_parameters_from_overrides=True.
    others : type, optional
        Parameters of other nodes that may be in the same parameter file.
    """

    def __init__(self, node: Node, kind: type[P], others: type[Parameters] = Parameters) -> None:
        self._rows = {row.name: row for row in kind.rows()}
        self._problems: dict[str, str] = {}
        for row in self._rows.values():  # with the value from command line or file, or the default
            value: Value = row.default
            if node.has_parameter(row.name):
                given = node.get_parameter(row.name).value
                node.undeclare_parameter(row.name)
                try:
                    value = row.validated(given)
                except OptionsError as error:
                    remedy = 'correct it and restart' if row.read_only else \
                        f'correct it with: ros2 param set {node.get_name()} {row.name} VALUE'
                    self._problems[row.name] = f'{error}; {remedy}'
            node.declare_parameter(row.name, value, row.descriptor, ignore_override=True)
        known = {*self._rows, *(row.name for row in others.rows()), *_FOREIGN_NAMES}
        for name in node.get_parameters_by_prefix(''):  # most are typing errors
            if name not in known and not name.startswith(_FOREIGN_PREFIXES):
                node.get_logger().warning(f"unknown parameter '{name}' has no effect"
                                          f'{did_you_mean(name, self._rows)}')
        #: The values, which may contradict each other. The object is replaced at a change, so
        #: that readers never see a partial change.
        self.values: P = kind(**{name: node.get_parameter(name).value for name in self._rows})
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._take)

    def snapshot(self) -> P:
        """Return the values.

        OptionsError: a value given at start-up is invalid, or values contradict each other.
        """
        if self._problems:
            raise OptionsError('parameter ' + '; '.join(self._problems.values()))
        values = self.values
        values.check()
        return values

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Allow a change if all values are valid together. Other callbacks may still refuse it."""
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
        """Apply a change that all callbacks allowed."""
        changed = self._validated(parameters)
        self.values = replace(self.values, **changed)
        self._problems = {name: text for name, text in self._problems.items()
                          if name not in changed}

    def _validated(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Return the validated values of parameters that the dataclass declares, by name."""
        return {parameter.name: self._rows[parameter.name].validated(parameter.value)
                for parameter in parameters if parameter.name in self._rows}
