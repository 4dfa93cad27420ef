# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The running relocalizer on the page: its last answer, and requests to it. No ROS here."""

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.studio.scene import wxyz_of

if TYPE_CHECKING:
    from cliploc_ros.studio.live import LivePose, LiveRelocalizer, LiveState
    from cliploc_ros.studio.page import Page

_CURRENT_RGB, _OLD_RGB = (30, 170, 60), (150, 150, 150)
# The relocalizer's camera is not known here; a usual one.
_FOV_RAD, _ASPECT = 0.85, 4.0 / 3.0
_FRUSTUM_M = 0.25
_AXES_M = 0.3
# Semi-axes of a standard deviation of 1 m [m].
_RADIUS_95 = float(np.sqrt(chi2.ppf(0.95, 3)))
# What can be seen and drawn [m].
_LEAST_M, _GREATEST_M = 1e-3, 100.0
_MAX_TEXT = 600


class LivePanel:
    """The last answer of the running relocalizer.

    Parameters
    ----------
    page : Page
    live : LiveRelocalizer
    """

    def __init__(self, page: 'Page', live: 'LiveRelocalizer'):
        self._page, self._live = page, live
        self._shown: LiveState | None = None
        self._handles: list[Any] = []
        gui = page.server.gui
        self._status = gui.add_html('')
        self._relocalize = gui.add_button('Relocalize the robot')
        self._reload = gui.add_button('Let it reload its map')
        look = gui.add_button('Look at its pose')
        self._relocalize.on_click(lambda event: page.ask(event, live.relocalize))
        self._reload.on_click(lambda event: page.ask(event, self._do_reload))
        look.on_click(self._look)
        live.subscribe(page.redraw_soon)

    def _do_reload(self) -> str:
        document = self._page.studio.document
        message = self._live.reload_map()
        return message if document.is_saved else f'{message}; without the edits not saved here'

    def _look(self, event: Any) -> None:
        pose = self._live.state.pose
        if event.client is not None and pose is not None:
            event.client.camera.look_at = pose.map_from_body[:3, 3]

    def show(self) -> None:
        """Show the relocalizer's state."""
        state = self._live.state
        if state is self._shown:
            return
        self._shown = state
        lines = '<br>'.join(html.escape(line[:_MAX_TEXT]) for line in self._lines(state))
        self._status.content = ('<div style="padding:0 1em;font-size:0.85em;'
                                f'overflow-wrap:anywhere">{lines}</div>')
        self._relocalize.disabled = self._reload.disabled = state.is_busy
        for handle in self._handles:
            handle.remove()
        frame_id = self._page.studio.document.frame_id
        self._handles = [] if state.pose is None or state.pose.frame_id != frame_id else \
            self._draw(state.pose, state)

    def _lines(self, state: 'LiveState') -> list[str]:
        document = self._page.studio.document
        lines = [f'{self._live.name}: nothing heard']
        if state.is_heard:
            lines = [f'{self._live.name}: {state.lifecycle}',
                     f'its map: {state.map_text or "none loaded"}']
            file = Path(state.map_file)
            if file.is_absolute() and file.resolve() != document.path.resolve():
                lines.append(f'it reads {file}, which is not the map of this studio')
        if state.is_busy:
            lines.append('waiting for its answer')
        lines.append(f'last answer: {state.verdict}' if state.verdict else 'no answer yet')
        if state.pose is not None:
            of = state.base_frame or 'the camera'
            lines.append(f'{"" if state.is_current else "earlier "}pose of {of}, stamp '
                         f'{state.pose.stamp_s:.2f} s')
            if state.pose.frame_id != document.frame_id:
                lines.append(f'the pose is in {state.pose.frame_id}, the map in '
                             f'{document.frame_id}: it is not shown')
        return lines

    def _draw(self, pose: 'LivePose', state: 'LiveState') -> list[Any]:
        """Draw the pose, grey where it is not the last answer; return the handles."""
        scene, rgb = self._page.server.scene, _CURRENT_RGB if state.is_current else _OLD_RGB
        wxyz, position = wxyz_of(pose.map_from_body), pose.map_from_body[:3, 3]
        handles: list[Any] = [scene.add_label(
            '/live/label', 'robot' if state.is_current else 'robot, earlier', position=position,
            anchor='top-center')]
        if state.base_frame:
            handles.append(scene.add_frame(
                '/live/body', axes_length=_AXES_M, axes_radius=0.05 * _AXES_M, origin_color=rgb,
                origin_radius=0.1 * _AXES_M, wxyz=wxyz, position=position))
        else:
            handles.append(scene.add_camera_frustum(
                '/live/body', _FOV_RAD, _ASPECT, scale=_FRUSTUM_M, color=rgb, wxyz=wxyz,
                position=position, variant='filled', cast_shadow=False, receive_shadow=False))
        semi_axes, basis = ellipsoid_95(pose.covariance)
        handles.append(scene.add_icosphere(
            '/live/ellipsoid', 1.0, rgb, scale=tuple(semi_axes.tolist()), opacity=0.35,
            wxyz=np.roll(Rotation.from_matrix(basis).as_quat(), 1), position=position,
            cast_shadow=False, receive_shadow=False))
        return handles


def ellipsoid_95(covariance: NDArray[np.float64]
                 ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the semi-axes (3,) [m] and their directions (3, 3) of the 95 % ellipsoid.

    Parameters
    ----------
    covariance : ndarray (3, 3)
        Of a position [m^2].
    """
    variances, basis = np.linalg.eigh((covariance + covariance.T) / 2.0)
    if np.linalg.det(basis) < 0.0:
        basis[:, 0] *= -1.0
    semi_axes = _RADIUS_95 * np.sqrt(np.maximum(variances, 0.0))
    return np.clip(semi_axes, _LEAST_M, _GREATEST_M), basis
