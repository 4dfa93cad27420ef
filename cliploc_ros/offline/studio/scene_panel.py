# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The panel of the scene: its layers, where a person looks from, and the recording as a film."""

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio import viewpoint
from cliploc_ros.offline.studio.context import draw_cloud, draw_walls, find_cloud
from cliploc_ros.offline.studio.panels import Actions
from cliploc_ros.offline.studio.scene import Labels, draw_keyframes

# Between the pictures of the film, and between the clicks of a double click [s].
_PICTURE_S, _DOUBLE_CLICK_S = 0.2, 0.6
_ALL, _ABOVE, _SELECTION = 'everything', 'from above', 'selection'
_PERSPECTIVE, _ORTHOGRAPHIC = 'perspective', 'orthographic'


class ScenePanel:
    """Layers of the scene to switch, viewpoints to fly to, and the recording to follow."""

    def __init__(self, actions: Actions, labels: Labels, recording: Sequence[Any]):
        self._actions, self._studio, self._labels = actions, actions.studio, labels
        self._recording = recording
        self._followed: int | None = None
        self._stops: threading.Event | None = None
        self._clicked: tuple[object, float] = None, 0.0
        gui, scene, studio = actions.server.gui, actions.server.scene, actions.studio
        for title, names, act in (('Look', (_ALL, _ABOVE, _SELECTION), self._look),
                                  ('View', (_PERSPECTIVE, _ORTHOGRAPHIC), self._project)):
            gui.add_button_group(title, names).on_click(act)
        self._cloud: list[Any] = []
        self._cloud_box = self._layer('Surfaces', self._cloud)
        if studio.grid is not None:
            self._layer('Walls', [draw_walls(scene, studio.grid)])
        self._layer('Labels', [self])
        if recording:
            self._cameras = self._layer('Cameras', recording)
        if studio.layer is not None:
            self._layer('Keyframes', draw_keyframes(scene, studio.layer), False)
        self._cloud_box.visible = False
        if studio.recording is not None:
            self._follows = gui.add_checkbox('Follow the view', False, hint='look from where the '
                                             'selected view was taken')
            self._play = gui.add_button('Play the recording')
            self._play.on_click(self._start_or_stop)
            self._follows.on_update(lambda event: actions.changed.set())
        threading.Thread(target=self._load, daemon=True).start()

    # ---- layers ---------------------------------------------------------------------------------

    def _layer(self, name: str, handles: Sequence[Any], is_shown: bool = True
               ) -> viser.GuiCheckboxHandle:
        """Add a switch for handles, or for anything else with an attribute ``visible``."""
        box = self._actions.server.gui.add_checkbox(name, is_shown)

        def show(event: object = None) -> None:
            for handle in handles:
                handle.visible = box.value

        box.on_update(show)
        show()
        return box

    @property
    def visible(self) -> bool:
        """Whether the labels are shown."""
        return self._labels.is_shown

    @visible.setter
    def visible(self, is_shown: bool) -> None:
        self._labels.is_shown = is_shown
        self._actions.changed.set()

    def _load(self) -> None:
        """Read the cloud, which takes seconds, while people use the page."""
        studio = self._studio
        with studio.document.lock:
            extent = studio.extent()
        try:
            cloud = find_cloud(None if studio.recording is None else studio.recording.detections,
                               studio.images, studio.layer, extent)
        except CliplocError as error:
            self._cloud_box.label, self._cloud_box.hint = 'No surfaces', str(error)
            self._cloud_box.visible = self._cloud_box.disabled = True
            return
        if cloud is not None:
            self._cloud.append(draw_cloud(self._actions.server.scene, cloud))
            self._cloud[0].visible = self._cloud_box.value
            self._cloud_box.visible = True

    # ---- viewpoints -----------------------------------------------------------------------------

    def _look(self, event: Any) -> None:
        if event.target.value == _SELECTION:
            self._actions.look_at_selection(event.client)
        else:
            self._actions.look_at_all(event.client, event.target.value == _ABOVE)

    def _project(self, event: Any) -> None:
        if event.client is not None:
            viewpoint.set_flat(event.client, event.target.value == _ORTHOGRAPHIC)

    def is_double(self, event: Any, landmark_id: str) -> bool:
        """Return whether this click on a landmark is the second one of a double click."""
        key, now = (event.client_id, landmark_id), time.monotonic()
        before, self._clicked = self._clicked, (key, now)
        return before[0] == key and now - before[1] < _DOUBLE_CLICK_S

    # ---- the recording as a film ----------------------------------------------------------------

    def stop(self) -> None:
        """Stop the film."""
        if self._stops is not None:
            self._stops.set()

    def show(self) -> None:
        """Let all browsers look from the selected view, if they follow it."""
        studio = self._studio
        if studio.recording is None:
            return
        view = studio.view if self._follows.value else None
        if (view is None) != (self._followed is None):  # the cameras nearby would be in the way
            for handle in self._recording:
                handle.visible = view is None and self._cameras.value
        if view is not None and view != self._followed:
            for client in self._actions.server.get_clients().values():
                viewpoint.look_through(client, studio.map_from_camera, studio.camera)
        self._followed = view

    def _start_or_stop(self, event: object) -> None:
        if self._stops is not None:
            self._stops.set()
            return
        self._stops, self._play.label = threading.Event(), 'Stop'
        threading.Thread(target=self._run_film, args=(self._stops,), daemon=True).start()

    def _run_film(self, stops: threading.Event) -> None:
        studio = self._studio
        assert studio.recording is not None
        interval_s = float(np.median(np.diff(np.unique(studio.recording.detections.stamps_s))))
        step = max(1, round(_PICTURE_S / max(interval_s, 1e-3)))
        while not stops.wait(_PICTURE_S) and studio.view < studio.views - 1:
            with studio.document.lock:
                studio.show_view(studio.view + step)
            self._actions.changed.set()
        self._stops, self._play.label = None, 'Play the recording'
