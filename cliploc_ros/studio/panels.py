# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The panels of the page: fields and buttons. Each reads the studio in ``show``."""

import html
import operator
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.studio import edits
from cliploc_ros.studio.edits import Change
from cliploc_ros.studio.landmark import LEAST_SEMI_AXIS_M
from cliploc_ros.studio.map_file import ChangedOnDiskError

if TYPE_CHECKING:
    from cliploc_ros.studio.page import Page

_ROWS = 8
_NO_PHRASE = '(choose a phrase)'
_SLIDER_MAX_M = 1.0
_SHORT = 70


def _set(handle: Any, **props: Any) -> None:
    """Set properties that differ: viser sends each that is set to all browsers."""
    for name, value in props.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def _button(page: 'Page', label: str, action: Callable[[], str | None], hotkey: Any = None,
            modifier: Any = None, then: Callable[[Any], None] = lambda event: None,
            **options: Any) -> Any:
    """Add a button, and a key that does the same; ``then`` follows with the lock released."""
    def run(event: Any) -> None:
        page.act(event, action)
        then(event)

    handle = page.server.gui.add_button(label, **options)
    handle.on_click(run)
    if hotkey is not None:
        command = page.server.gui.add_command(label, hotkey=hotkey, modifier=modifier)
        command.on_trigger(run)
    return handle


class Field:
    """A field that a person edits and the studio shows.

    A stroke reaches the studio later than the field. So the field is only set where the studio's
    value differs from the last one that was shown or typed: redrawing takes no stroke back.

    Parameters
    ----------
    handle : viser's handle
    """

    def __init__(self, handle: Any):
        self.handle = handle
        self._known = handle.value

    def typed(self) -> Any:
        """Return what a person typed."""
        self._known = self.handle.value
        return self._known

    def show(self, value: Any, is_same: Callable[[Any, Any], bool] = operator.eq) -> None:
        """Show a value, unless what is there means the same."""
        if not is_same(self._known, value):
            self.handle.value = value
            self._known = value


class MapPanel:
    """File, undo and redo."""

    def __init__(self, page: 'Page'):
        self._page, self._document = page, page.studio.document
        self._found = ''
        gui = page.server.gui
        self._status = gui.add_html('')
        self._save = _button(page, 'Save', self._do_save, 'S', 'cmd/ctrl')
        self._undo = _button(page, 'Undo', page.studio.undo, 'Z', 'cmd/ctrl')
        self._redo = _button(page, 'Redo', page.studio.redo, 'Y', 'cmd/ctrl')
        _button(page, 'Export as one page', page.export)
        with gui.add_folder('The file changed on disk', visible=False) as self._conflict:
            _button(page, 'Overwrite it', self._overwrite, color='red')
            _button(page, 'Reload it (undo takes back)', self._reload)

    def _do_save(self) -> str:
        return self._save_over('')

    def _save_over(self, found: str) -> str:
        try:
            self._document.save(over=found)
        except ChangedOnDiskError as error:
            self._found = error.found
            raise
        self._found = ''
        return f'saved {self._document.path.name}'

    def _overwrite(self) -> str:
        return self._save_over(self._found)

    def _reload(self) -> str:
        self._document.reload()
        self._found = ''
        return f'reloaded {self._document.path.name}'

    def show(self) -> None:
        """Show the document's state."""
        document = self._document
        state = 'saved' if document.is_saved else 'unsaved edits'
        lines = [f'<b>{html.escape(document.path.name)}</b>: {state}',
                 f'{len(document.landmarks)} landmarks in {html.escape(document.frame_id)}, '
                 f'{len(document.selection)} selected',
                 *(html.escape(note) for note in document.notes)]
        _set(self._status, content='<div style="padding:0 1em 0.5em;font-size:0.85em">'
             f'{"<br>".join(lines)}</div>')
        _set(self._undo, label=f'Undo {document.to_undo or ""}'[:_SHORT],
             disabled=document.to_undo is None)
        _set(self._redo, label=f'Redo {document.to_redo or ""}'[:_SHORT],
             disabled=document.to_redo is None)
        _set(self._save, color=None if document.is_saved else 'green')
        _set(self._conflict, visible=bool(self._found))


class LandmarkPanel:
    """The selected landmark: its numbers, texts, and what can be done to it."""

    def __init__(self, page: 'Page'):
        self._page, self._studio = page, page.studio
        gui = page.server.gui
        with gui.add_folder('Selected landmark') as self._folder:
            self._name = gui.add_html('')
            self._label = Field(gui.add_text('Label', ''))
            self._phrases = Field(gui.add_dropdown('Phrases', (_NO_PHRASE,)))
            self._class = Field(gui.add_text('Class', ''))
            self._center = Field(gui.add_vector3('Position [m]', (0.0, 0.0, 0.0), step=0.001))
            self._angles = Field(gui.add_vector3('Roll pitch yaw [deg]', (0.0, 0.0, 0.0),
                                                 step=0.1))
            self._sliders = [Field(gui.add_slider(f'Semi-axis {name} [m]', LEAST_SEMI_AXIS_M,
                                                  _SLIDER_MAX_M, 0.001, 0.1)) for name in 'xyz']
            self._buttons = [_button(page, label, action, hotkey) for label, action, hotkey in (
                ('Lock or unlock', self._studio.toggle_lock, 'L'),
                ('Split', self._studio.split, None), ('Merge', self._studio.merge, 'M'),
                ('Refit to boxes', self._studio.refit, 'R'),
                ('Delete', self._studio.delete, 'delete'),
                ('Show best view', self._studio.best_view, 'V'))]
        _button(page, 'Refit all unlocked', self._studio.refit_all)
        self._connect()

    def _connect(self) -> None:
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
            self._edit(slider, partial(self._resize, axis))

    def _resize(self, axis: int, landmarks: Any, key: str, length: float) -> Change:
        semi_axes = landmarks[key].semi_axes.copy()
        semi_axes[axis] = length
        return edits.set_axes(landmarks, key, semi_axes)

    def _edit(self, field: Field, make: Callable[[Any, str, Any], Change],
              is_complete: Callable[[Any], bool] = lambda value: True) -> None:
        """Let a field edit the selected landmark; its strokes in a row are undone together."""
        def changed(event: Any) -> None:
            # the studio's own updates come without a client
            if event.client is not None:
                self._page.act(event, apply)

        def apply() -> None:
            document = self._studio.document
            # an incomplete value is left alone, or else a cleared label would come back
            if document.selected is not None and is_complete(field.handle.value):
                value, (key, _) = field.typed(), document.selected
                document.apply(make(document.landmarks, key, value), gesture=(id(field), key))

        field.handle.on_update(changed)

    def show(self) -> None:
        """Show the selected landmark."""
        selected = self._studio.document.selected
        for field in (self._label, self._phrases, self._class, self._center, self._angles,
                      *self._sliders):
            _set(field.handle, disabled=selected is None or selected[1].is_locked)
        for button in self._buttons:
            _set(button, disabled=not self._studio.document.selection)
        if selected is None:
            names = ', '.join(self._studio.document.selection) or 'nothing is selected'
            _set(self._name, content=_paragraph([names[:1000]]))
            return
        key, one = selected
        _set(self._name, content=_paragraph([
            f'{key}{" (locked)" if one.is_locked else ""}', *self._studio.faults(key),
            *filter(None, [self._studio.phrase_note])]))
        phrases = (_NO_PHRASE, *self._studio.phrases())
        if tuple(self._phrases.handle.options) != phrases:
            self._phrases.handle.options = phrases
        self._phrases.show(_NO_PHRASE)
        # while a person types, a field may end in a space that the label does not have
        self._label.show(one.label, _same_text)
        self._class.show(one.class_id, _same_text)
        self._center.show(tuple(float(value) for value in one.center), _same_numbers)
        angles = Rotation.from_quat(one.quat_xyzw).as_euler('xyz', degrees=True)
        self._angles.show(tuple(round(float(angle), 3) + 0.0 for angle in angles),
                          _same_rotation)
        for slider, length in zip(self._sliders, one.semi_axes, strict=True):
            if length > slider.handle.max:
                slider.handle.max = float(2.0 * length)
            slider.show(round(float(length), 3))


def _same_text(shown: str, text: str) -> bool:
    return ' '.join(shown.split()) == text


def _same_numbers(shown: Any, values: Any) -> bool:
    return bool(np.abs(np.subtract(shown, values)).max() <= 5e-7)


def _same_rotation(shown: Any, angles: Any) -> bool:
    """Return whether angles turn alike: they are not unique."""
    first, second = (Rotation.from_euler('xyz', one, degrees=True) for one in (shown, angles))
    return bool((first.inv() * second).magnitude() < 1e-4)


def _paragraph(lines: list[str]) -> str:
    inner = '<br>'.join(html.escape(line) for line in lines)
    return f'<div style="padding:0 1em;font-size:0.85em">{inner}</div>'


class TablePanel:
    """The landmarks as rows to click, the worst first once they are checked."""

    def __init__(self, page: 'Page'):
        self._page, self._studio = page, page.studio
        self._first = 0
        self._ids: list[str] = []
        self._followed: tuple[str, ...] = ()
        gui = page.server.gui
        with gui.add_folder('Landmarks'):
            self._search = gui.add_text('Find', '')
            self._search.on_update(lambda event: self._turn(-len(self._studio.rows())))
            self._several = gui.add_checkbox(
                'Select several', False, hint='a row or an ellipsoid joins the selection or '
                'leaves it; in the scene, shift and a click do the same')
            self._rows = [gui.add_button('', visible=False) for _ in range(_ROWS)]
            self._pages = gui.add_button_group('Rows', ('previous', 'next'))
            _button(page, 'Check against the recording', self._studio.check)
            for label, action, hotkey in (('Next landmark', self._studio.select_next, 'N'),
                                          ('Accept and next', self._studio.accept, 'A')):
                _button(page, label, action, hotkey, then=page.look_at_selection)
        for number, row in enumerate(self._rows):
            row.on_click(partial(self._clicked, number))
        self._pages.on_click(lambda event: self._turn(
            _ROWS if self._pages.value == 'next' else -_ROWS))

    def _clicked(self, number: int, event: Any) -> None:
        if number < len(self._ids):
            key = self._ids[number]
            self._page.select(event, key, self.selects_several)

    @property
    def selects_several(self) -> bool:
        """Return whether a click joins the selection."""
        return bool(self._several.value)

    def _turn(self, rows: int) -> None:
        self._first = max(0, self._first + rows)
        self._page.act(None, lambda: None)

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
                _set(handle, visible=False)
                continue
            row = shown[number]
            is_selected = row.landmark_id in self._studio.document.selection
            color = ('yellow' if is_selected else 'red' if row.severity >= 1.0
                     else 'orange' if row.severity > 0.0 else 'gray')
            _set(handle, visible=True, label=row.text[:_SHORT], color=color)


class ViewPanel:
    """The selected view: its picture, and boxes for a new landmark."""

    def __init__(self, page: 'Page', panel: Any):
        self._page, self._studio = page, page.studio
        gui = page.server.gui
        with panel.add_tab('View'):
            self._view = Field(gui.add_slider('View', 0, max(1, self._studio.views - 1), 1, 0))
            self._picture = gui.add_image(np.zeros((3, 4, 3), dtype=np.uint8), format='jpeg')
            look = gui.add_button('Look through this view')
            here = gui.add_button('Relocalize here')
            everywhere = gui.add_button('Relocalize the recording')
            with gui.add_folder('New landmark from boxes'):
                self._drawing = gui.add_checkbox(
                    'Draw boxes', False, hint='drag on the image in the scene, or click a '
                    'box of the detector; one box in each of two or three views')
                self._corner = gui.add_vector2('Left, top [px]', (0.0, 0.0), step=1.0)
                self._other = gui.add_vector2('Right, bottom [px]', (0.0, 0.0), step=1.0)
                _button(page, 'Draw this box', lambda: self._studio.draw_box(
                    self._corner.value, self._other.value))
                self._label = gui.add_text('New label', '')
                self._class = gui.add_text('New class', '')
                self._create = _button(page, 'Create landmark', lambda: self._studio.create(
                    self._label.value, self._class.value), color='green')
                _button(page, 'Forget the boxes', self._studio.clear_boxes)
        look.on_click(page.look_through)
        here.on_click(lambda event: page.ask(event, self._studio.relocalize_here))
        everywhere.on_click(lambda event: page.ask(event, self._studio.relocalize_all))
        self._view.handle.on_update(self._chosen)
        self._drawing.on_update(self._toggled)

    def _chosen(self, event: Any) -> None:
        if event.client is not None:
            self._page.act(event, lambda: self._studio.show_view(self._view.typed()))

    def _toggled(self, event: Any) -> None:
        self._page.is_drawing = self._drawing.value

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show the picture of the selected view."""
        self._picture.image = picture
        self._view.show(self._studio.view)
        count = len(self._studio.drawn)
        _set(self._create, label=f'Create landmark from {count} boxes', disabled=count < 2)
