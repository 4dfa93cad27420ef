# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a person does on the page, and the panels: fields and buttons.

Data moves one way: a callback of viser runs an action of the studio, each change wakes the page's
redrawer, and this calls ``show`` of each panel, which reads the studio.
"""

import html
import operator
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.studio import edits, viewpoint
from cliploc_ros.studio.landmark import LEAST_SEMI_AXIS_M
from cliploc_ros.studio.map_file import ChangedOnDiskError
from cliploc_ros.studio.studio import Studio

_ROWS = 8
_NO_PHRASE = '(choose a phrase)'
_SLIDER_MAX_M = 1.0
_SHORT = 70


class Actions:
    """Runs the actions of the people at the page, and tells each the outcome.

    Attributes
    ----------
    changed : Event
        Set by any thread when there is something to redraw.
    """

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self.studio, self.server = studio, server
        self.changed = threading.Event()
        studio.document.subscribe(self.changed.set)
        if studio.finder is not None:
            studio.finder.subscribe(self.changed.set)

    def act(self, event: Any, action: Callable[[], str | None]) -> None:
        """Do something with the studio locked, and tell the person who did it the outcome."""
        def locked() -> str | None:
            with self.studio.document.lock:
                return action()

        self.ask(event, locked)

    def ask(self, event: Any, action: Callable[[], str | None]) -> None:
        """Do something that takes long and only reads the document; tell the outcome."""
        client = getattr(event, 'client', None)
        try:
            message = action()
        except CliplocError as error:
            self.notify(client, 'Not done', str(error), 'red')
            return
        except Exception as error:
            self.notify(client, 'Internal error', f'{error}; the terminal has more', 'red')
            raise
        finally:
            self.changed.set()
        if message:
            self.notify(client, 'Done', message, None)

    def notify(self, client: viser.ClientHandle | None, title: str, text: str, color: Any) -> None:
        """Show a notification to one browser, or to all."""
        for one in [client] if client is not None else self.server.get_clients().values():
            one.add_notification(title, text, auto_close_seconds=8, color=color)

    def button(self, label: str, action: Callable[[], str | None], hotkey: Any = None,
               modifier: Any = None, then: Callable[[Any], None] | None = None,
               **options: Any) -> Any:
        """Add a button, and a key that does the same; ``then`` follows with the lock released."""
        def run(event: Any) -> None:
            self.act(event, action)
            if then is not None:
                then(event)

        handle = self.server.gui.add_button(label, **options)
        handle.on_click(run)
        if hotkey is not None:
            self.server.gui.add_command(label, hotkey=hotkey, modifier=modifier).on_trigger(run)
        return handle

    def select(self, event: Any, landmark_id: str, joins: bool) -> None:
        """Select a landmark, alone or together with those that are selected."""
        if joins:
            self.act(event, lambda: self.studio.toggle(landmark_id))
        else:
            self.act(event, lambda: self.studio.document.select([landmark_id]))

    def look_at_selection(self, event: Any) -> None:
        """Let the camera of the person who selected fly to the selected landmark."""
        with self.studio.document.lock:
            selected, up = self.studio.document.selected, self.studio.extent().up
        if event.client is not None and selected is not None:
            viewpoint.fly_to(event.client, selected[1].center, selected[1].semi_axes.max(), up)


def show_props(handle: Any, **props: Any) -> None:
    """Set properties that differ: viser sends each that is set to all browsers."""
    for name, value in props.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def paragraph(lines: list[str], style: str = 'padding:0 1em') -> str:
    """Return lines of HTML as one paragraph of small text."""
    return f'<div style="{style};font-size:0.85em">{"<br>".join(lines)}</div>'


class Field:
    """A field that a person edits and the studio shows.

    A stroke reaches the studio later than the field. So the field is only set where the studio's
    value differs from the last one that was shown or typed: redrawing takes no stroke back.
    """

    def __init__(self, handle: Any):
        self.handle = handle
        self._known = handle.value

    def on_typed(self, actions: Actions, action: Callable[[], str | None]) -> None:
        """Run an action when a person changes the field."""
        def changed(event: Any) -> None:
            if event.client is not None:  # the studio's own updates come without a client
                actions.act(event, action)

        self.handle.on_update(changed)

    def typed(self) -> Any:
        """Return the value that a person typed."""
        self._known = self.handle.value
        return self._known

    def show(self, value: Any, is_same: Callable[[Any, Any], bool] = operator.eq) -> None:
        """Show a value, unless what is there means the same."""
        if not is_same(self._known, value):
            self.handle.value = value
            self._known = value


class MapPanel:
    """File, undo and redo."""

    def __init__(self, actions: Actions):
        self._document, self._server = actions.studio.document, actions.server
        # the digest of a foreign content of the file, of which the person has to decide
        self._found = ''
        gui, button = actions.server.gui, actions.button
        self._status = gui.add_html('')
        self._save = button('Save', lambda: self._save_over(''), 'S', 'cmd/ctrl')
        self._undo = button('Undo', actions.studio.undo, 'Z', 'cmd/ctrl')
        self._redo = button('Redo', actions.studio.redo, 'Y', 'cmd/ctrl')
        button('Export as one page', self._export)
        with gui.add_folder('The file changed on disk', visible=False) as self._conflict:
            button('Overwrite it', lambda: self._save_over(self._found), color='red')
            button('Reload it (undo takes back)', self._reload)

    def _save_over(self, found: str) -> str:
        try:
            self._document.save(over=found)
        except ChangedOnDiskError as error:
            self._found = error.found
            raise
        self._found = ''
        return f'saved {self._document.path.name}'

    def _reload(self) -> str:
        self._document.reload()
        self._found = ''
        return f'reloaded {self._document.path.name}'

    def _export(self) -> str:
        """Write the scene as one page that opens without a server."""
        path = self._document.path.with_suffix('.html')
        try:
            with replace_file(path) as partial:
                partial.write_text(self._server.scene.as_html(), encoding='utf-8')
        except OSError as error:
            raise MapError(f'{path}: cannot be written: {error.strerror}') from error
        return f'wrote {path.name}; open it in a browser'

    def show(self) -> None:
        """Show the document's state."""
        document = self._document
        state = 'saved' if document.is_saved else 'unsaved edits'
        lines = [f'<b>{html.escape(document.path.name)}</b>: {state}',
                 f'{len(document.landmarks)} landmarks in {html.escape(document.frame_id)}, '
                 f'{len(document.selection)} selected',
                 *(html.escape(note) for note in document.notes)]
        show_props(self._status, content=paragraph(lines, 'padding:0 1em 0.5em'))
        for handle, name, what in ((self._undo, 'Undo', document.to_undo),
                                   (self._redo, 'Redo', document.to_redo)):
            show_props(handle, label=f'{name} {what or ""}'[:_SHORT], disabled=what is None)
        show_props(self._save, color=None if document.is_saved else 'green')
        show_props(self._conflict, visible=bool(self._found))


class LandmarkPanel:
    """The selected landmark: its numbers, texts, and what can be done to it."""

    def __init__(self, actions: Actions):
        self._actions, self._studio = actions, actions.studio
        gui, studio = actions.server.gui, actions.studio
        with gui.add_folder('Selected landmark'):
            self._name = gui.add_html('')
            self._label = Field(gui.add_text('Label', ''))
            self._phrases = Field(gui.add_dropdown('Phrases', (_NO_PHRASE,)))
            self._class = Field(gui.add_text('Class', ''))
            self._center = Field(gui.add_vector3('Position [m]', (0.0, 0.0, 0.0), step=0.001))
            self._angles = Field(gui.add_vector3('Roll pitch yaw [deg]', (0.0, 0.0, 0.0),
                                                 step=0.1))
            self._sliders = [Field(gui.add_slider(f'Semi-axis {name} [m]', LEAST_SEMI_AXIS_M,
                                                  _SLIDER_MAX_M, 0.001, 0.1)) for name in 'xyz']
            self._buttons = [actions.button(label, action, hotkey) for label, action, hotkey in (
                ('Lock or unlock', studio.toggle_lock, 'L'), ('Split', studio.split, None),
                ('Merge', studio.merge, 'M'), ('Refit to boxes', studio.refit, 'R'),
                ('Delete', studio.delete, 'delete'),
                ('Show best view', studio.best_view, 'V'))]
        actions.button('Refit all unlocked', studio.refit_all)
        self._edit(self._label, lambda all, key, text: edits.relabel(all, [key], text),
                   lambda text: bool(text.strip()))
        self._edit(self._class, lambda all, key, text: edits.reclass(all, [key], text),
                   lambda text: bool(text.strip()))
        self._edit(self._phrases, lambda all, key, text: edits.relabel(all, [key], text),
                   lambda text: text != _NO_PHRASE)
        self._edit(self._center, edits.move)
        self._edit(self._angles, lambda all, key, angles: edits.rotate(
            all, key, Rotation.from_euler('xyz', angles, degrees=True).as_quat()))
        for axis, slider in enumerate(self._sliders):
            self._edit(slider, lambda all, key, length, axis=axis: edits.set_axes(
                all, key, np.where(np.arange(3) == axis, length, all[key].semi_axes)))

    def _edit(self, field: Field, make: Callable[..., edits.Change],
              is_complete: Callable[[Any], bool] = lambda value: True) -> None:
        """Let a field edit the selected landmark; its strokes in a row are undone together."""
        def apply() -> None:
            document = self._studio.document
            # an incomplete value is left alone, or else a cleared label would come back
            if document.selected is not None and is_complete(field.handle.value):
                value, (key, _) = field.typed(), document.selected
                document.apply(make(document.landmarks, key, value), gesture=(id(field), key))

        field.on_typed(self._actions, apply)

    def show(self) -> None:
        """Show the selected landmark."""
        selected = self._studio.document.selected
        for field in (self._label, self._phrases, self._class, self._center, self._angles,
                      *self._sliders):
            show_props(field.handle, disabled=selected is None or selected[1].is_locked)
        for button in self._buttons:
            show_props(button, disabled=not self._studio.document.selection)
        if selected is None:
            names = ', '.join(self._studio.document.selection) or 'nothing is selected'
            show_props(self._name, content=paragraph([html.escape(names[:1000])]))
            return
        key, one = selected
        show_props(self._name, content=paragraph([html.escape(line) for line in (
            f'{key}{" (locked)" if one.is_locked else ""}', *self._studio.faults(key),
            self._studio.phrase_note) if line]))
        phrases = (_NO_PHRASE, *self._studio.phrases())
        if tuple(self._phrases.handle.options) != phrases:
            self._phrases.handle.options = phrases
        self._phrases.show(_NO_PHRASE)
        # while a person types, a field may end in a space that the label does not have
        self._label.show(one.label, _same_text)
        self._class.show(one.class_id, _same_text)
        self._center.show(tuple(float(value) for value in one.center), lambda shown, values: bool(
            np.abs(np.subtract(shown, values)).max() <= 5e-7))
        angles = Rotation.from_quat(one.quat_xyzw).as_euler('xyz', degrees=True)
        self._angles.show(tuple(round(float(angle), 3) + 0.0 for angle in angles),
                          _same_rotation)
        for slider, length in zip(self._sliders, one.semi_axes, strict=True):
            if length > slider.handle.max:
                slider.handle.max = float(2.0 * length)
            slider.show(round(float(length), 3))


def _same_text(shown: str, text: str) -> bool:
    return ' '.join(shown.split()) == text


def _same_rotation(shown: Any, angles: Any) -> bool:
    """Return whether angles turn alike: they are not unique."""
    first, second = (Rotation.from_euler('xyz', one, degrees=True) for one in (shown, angles))
    return bool((first.inv() * second).magnitude() < 1e-4)


class TablePanel:
    """The landmarks as rows to click, the worst first once they are checked."""

    def __init__(self, actions: Actions):
        self._actions, self._studio = actions, actions.studio
        self._first = 0
        self._ids: list[str] = []
        self._followed: tuple[str, ...] = ()
        gui, button = actions.server.gui, actions.button
        with gui.add_folder('Landmarks'):
            self._search = gui.add_text('Find', '')
            self._several = gui.add_checkbox(
                'Select several', False, hint='a row or an ellipsoid joins the selection or '
                'leaves it; in the scene, shift and a click do the same')
            self._rows = [gui.add_button('', visible=False) for _ in range(_ROWS)]
            pages = gui.add_button_group('Rows', ('previous', 'next'))
            button('Check against the recording', self._studio.check)
            button('Next landmark', self._studio.select_next, 'N', then=actions.look_at_selection)
            button('Accept and next', self._studio.accept, 'A', then=actions.look_at_selection)
        for number, row in enumerate(self._rows):
            row.on_click(partial(self._clicked, number))
        self._search.on_update(lambda event: self._turn_to(0))
        pages.on_click(lambda event: self._turn_to(
            self._first + (_ROWS if pages.value == 'next' else -_ROWS)))

    @property
    def selects_several(self) -> bool:
        """Whether a click joins the selection."""
        return bool(self._several.value)

    def _clicked(self, number: int, event: Any) -> None:
        if number < len(self._ids):
            self._actions.select(event, self._ids[number], self.selects_several)
            self._actions.look_at_selection(event)

    def _turn_to(self, first: int) -> None:
        self._first = max(0, first)
        self._actions.changed.set()

    def show(self) -> None:
        """Show one page of rows; a new selection turns to its page."""
        rows = self._studio.rows(self._search.value)
        selection = self._studio.document.selection
        if selection != self._followed:
            self._followed = selection
            for place, one in enumerate(rows):
                if selection and one.landmark_id == selection[-1]:
                    self._first = place // _ROWS * _ROWS
        if self._first >= max(1, len(rows)):
            self._first = max(0, (len(rows) - 1) // _ROWS * _ROWS)
        shown = rows[self._first:self._first + _ROWS]
        self._ids = [row.landmark_id for row in shown]
        for number, handle in enumerate(self._rows):
            if number >= len(shown):
                show_props(handle, visible=False)
                continue
            row = shown[number]
            is_selected = row.landmark_id in self._studio.document.selection
            color = ('yellow' if is_selected else 'red' if row.severity >= 1.0
                     else 'orange' if row.severity > 0.0 else 'gray')
            show_props(handle, visible=True, label=row.text[:_SHORT], color=color)


class ViewPanel:
    """The selected view: its picture, and boxes for a new landmark."""

    def __init__(self, actions: Actions):
        self._actions, self._studio = actions, actions.studio
        gui, button, studio = actions.server.gui, actions.button, actions.studio
        self._view = Field(gui.add_slider('View', 0, max(1, studio.views - 1), 1, 0))
        self._camera = gui.add_html('')
        self._picture = gui.add_image(np.zeros((3, 4, 3), dtype=np.uint8), format='jpeg')
        look = gui.add_button('Look through this view')
        here = gui.add_button('Relocalize here')
        everywhere = gui.add_button('Relocalize the recording')
        with gui.add_folder('New landmark from boxes'):
            self._drawing = gui.add_checkbox(
                'Draw boxes', False, hint='drag on the image in the scene, or click a '
                'box of the detector; one box in each of two or three views')
            corner = gui.add_vector2('Left, top [px]', (0.0, 0.0), step=1.0)
            other = gui.add_vector2('Right, bottom [px]', (0.0, 0.0), step=1.0)
            button('Draw this box', lambda: studio.draw_box(corner.value, other.value))
            label, name = gui.add_text('New label', ''), gui.add_text('New class', '')
            self._create = button('Create landmark',
                                  lambda: studio.create(label.value, name.value), color='green')
            button('Forget the boxes', studio.clear_boxes)
        look.on_click(self._look_through)
        here.on_click(lambda event: actions.ask(event, studio.relocalize_here))
        everywhere.on_click(lambda event: actions.ask(event, studio.relocalize_all))
        self._view.on_typed(actions, lambda: studio.show_view(self._view.typed()))

    @property
    def is_drawing(self) -> bool:
        """Whether the person draws boxes."""
        return bool(self._drawing.value)

    def _look_through(self, event: Any) -> None:
        """Put the camera of the person who clicked where the selected view was taken."""
        if event.client is None or self._studio.recording is None:
            return
        with self._studio.document.lock:
            pose, intrinsics = self._studio.map_from_camera, self._studio.camera
        viewpoint.look_through(event.client, pose, intrinsics)

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show the picture of the selected view."""
        self._picture.image = picture
        self._view.show(self._studio.view)
        if name := self._studio.camera_name:
            show_props(self._camera, content=paragraph([f'camera <b>{html.escape(name)}</b>']))
        count = len(self._studio.drawn)
        show_props(self._create, label=f'Create landmark from {count} boxes', disabled=count < 2)
