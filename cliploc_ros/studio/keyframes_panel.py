# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer of keyframes in the scene: where they were taken, and the points of their features."""

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from cliploc_ros.core.geometry.frustum import frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.studio.scene import some_cameras

_RGB = (0, 150, 136)
_FRUSTUM_M, _POINT_M = 0.12, 0.015
# More points slow the browser down.
_MOST_POINTS = 30_000


class KeyframesPanel:
    """A switch for the layer, which is drawn when it is first shown.

    Parameters
    ----------
    server : viser.ViserServer
    layer : KeyframeLayer
    """

    def __init__(self, server: viser.ViserServer, layer: KeyframeLayer):
        self._scene, self._layer = server.scene, layer
        self._handles: list[Any] = []
        images = 'no images' if layer.images is None else 'small images'
        self._box = server.gui.add_checkbox(
            'Show keyframes', False,
            hint=f'{len(layer)} keyframes with {layer.offsets[-1]} points, {images}')
        self._box.on_update(lambda event: self._show())

    def _show(self) -> None:
        if self._box.value and not self._handles:
            self._handles = self._draw()
        for handle in self._handles:
            handle.visible = self._box.value

    def _draw(self) -> list[Any]:
        layer = self._layer
        shown = some_cameras(len(layer))
        lines = self._scene.add_line_segments(
            '/keyframes/cameras', frusta(layer.camera, layer.map_from_camera[shown], _FRUSTUM_M),
            _RGB, thickness=2.0, thickness_units='screen')
        points = some_points(layer)
        cloud = self._scene.add_point_cloud('/keyframes/points', points.astype(np.float32), _RGB,
                                            point_size=_POINT_M, point_shape='circle')
        return [lines, cloud]


def some_points(layer: KeyframeLayer) -> NDArray[np.float64]:
    """Return the points (n, 3) of all keyframes in the map, or every n-th of many [m]."""
    step = max(1, -(-int(layer.offsets[-1]) // _MOST_POINTS))
    return np.concatenate([layer.points_in_map(row)[::step] for row in range(len(layer))])
