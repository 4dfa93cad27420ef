# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps at run time: ``~/reload_map``, and ``~/load_map`` where nav2_msgs is installed."""

import importlib
import threading
from pathlib import Path
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.ros import qos
from cliploc_ros.ros.map_parameters import path_of
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.request import Pipeline


class MapServices:
    """Reads maps in the node's worker, never in the middle of a search.

    Parameters
    ----------
    group : CallbackGroup
        Of the services.
    """

    def __init__(self, node: ManagedNode[RelocalizerParameters], pipeline: Pipeline,
                 group: CallbackGroup) -> None:
        self._node = node
        self._pipeline = pipeline
        # Between the parameters of a map and its reading, nobody else may set them.
        self._lock = threading.Lock()
        node.create_service(Trigger, '~/reload_map', self._on_reload, qos_profile=qos.SERVICE,
                            callback_group=group)
        try:
            load_map = importlib.import_module('nav2_msgs.srv').LoadMap
        except ImportError:
            return  # map_file and reload_map do the same
        node.create_service(load_map, '~/load_map', self._on_load, qos_profile=qos.SERVICE,
                            callback_group=group)

    def load(self, map_url: str) -> str:
        """Search one map from now on; return what was loaded, in one line.

        Parameters
        ----------
        map_url : str
            See cliploc_ros.ros.map_parameters.

        Raises
        ------
        CliplocError
            Names what to fix; parameters and maps stay as they were.
        """
        with self._lock:
            before = {name: getattr(self._node.settings.values, name)
                      for name in ('map_file', 'map_files')}
            self._set(map_file=map_url, map_files=[''])
            try:
                return self._node.worker.run(self._pipeline.reload_map)
            except CliplocError:
                self._set(**before)
                raise

    def _set(self, **values: Any) -> None:
        self._node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()])

    def _on_reload(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            with self._lock:
                description, map_hash = self._node.worker.run(self._reload)
            response.message = f'loaded: {description}; map {map_hash}'
            response.success = True
        except CliplocError as error:
            response.message = f'not loaded: {error}'
        self._node.get_logger().info(f'map {response.message}')
        return response

    def _reload(self) -> tuple[str, str]:
        """Read the map again, in the worker's thread; return what was loaded, and its hash."""
        description = self._pipeline.reload_map()
        assert self._pipeline.localizer is not None
        return description, self._pipeline.localizer.map_hash

    def _on_load(self, request: Any, response: Any) -> Any:
        try:
            self._node.get_logger().info(f'map loaded: {self.load(request.map_url)}')
            response.result = response.RESULT_SUCCESS
        except CliplocError as error:
            self._node.get_logger().error(f'map not loaded: {error}')
            response.result = response.RESULT_INVALID_MAP_DATA if _is_there(request.map_url) \
                else response.RESULT_MAP_DOES_NOT_EXIST
        return response


def _is_there(map_url: str) -> bool:
    try:
        return Path(path_of(map_url)).exists()
    except MapError:
        return False
