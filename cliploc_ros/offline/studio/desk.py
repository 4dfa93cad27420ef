# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the page shows, part by part, and what each of its messages does.

Data moves one way: a message of the page runs an action of the studio, each change wakes the
page's redrawer, and this sends the parts that differ.
"""

import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.offline.studio import edits, viewpoint
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.images import Outline, outlines_of
from cliploc_ros.offline.studio.landmark import Landmark, shape_fields
from cliploc_ros.offline.studio.map_file import ChangedOnDiskError
from cliploc_ros.offline.studio.panels import Actions
from cliploc_ros.offline.studio.sightings import SightingFinder, crop_of
from cliploc_ros.offline.studio.tool_panels import LivePanel, PlacesPanel
from cliploc_ros.offline.studio.web import Content

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveRelocalizer

# More outlines hide the image, and a drag would wait for them.
_MAX_OUTLINES = 200
_CROP_MARGIN, _CROP_PX, _QUALITY = 0.25, 160, 88
_MAX_SHOWN = 60
# Answers that are listed after a run over the recording.
_MAX_ANSWERS = 100


class Message(dict[str, Any]):
    """What a page says: the name of a command, and its values."""

    def __missing__(self, name: str) -> Any:
        """Say that a value is missing."""
        raise EditError(f"the page's message '{self.get('do')}' lacks '{name}'")


class Desk:
    """The studio as the page sees it. ``find_client`` returns the scene's client of a person."""

    def __init__(self, actions: Actions, find_client: Callable[[str], viser.ClientHandle | None],
                 live: 'LiveRelocalizer | None' = None):
        self._actions, self._studio = actions, actions.studio
        self._find_client = find_client
        self.places = PlacesPanel(actions)
        self.robot = None if live is None else LivePanel(actions, live)
        recording = self._studio.recording
        self._finder = None if recording is None else SightingFinder(
            recording, self._studio.images, actions.changed.set)
        self._modes: dict[str, str] = {}
        # the digest of a foreign content of the file, of which the person has to decide
        self._found = ''
        self._commands = self._make_commands()
        self._slow = self._make_slow_commands()

    def stop(self) -> None:
        """Stop the searches."""
        self.places.search.stop()
        if self._finder is not None:
            self._finder.stop()

    # ---- what a person does ---------------------------------------------------------------------

    def do(self, person: str, content: dict[str, Any]) -> None:
        """Do what a message says."""
        message = Message(content)
        name = str(message.get('do'))
        if name == 'mode':
            self.show_mode(person, str(message.get('mode')))
        elif name in self._slow:
            threading.Thread(target=self._do_slowly, args=(name,), daemon=True).start()
        elif name in self._commands:
            self._actions.act(lambda: self._commands[name](message))
            if name in ('next', 'previous', 'accept', 'review_delete', 'create') or (
                    name in ('select', 'select_at') and not message.get('joins')):
                self._look(person, 'fly')
        else:
            self._look(person, name)

    def show_mode(self, person: str, mode: str) -> None:
        """Take the mode of a person's page, '' once it is closed; only test shows coverage."""
        if mode:
            self._modes[person] = mode
        else:
            self._modes.pop(person, None)
        self.places.set_wanted('test' in self._modes.values())

    def _do_slowly(self, name: str) -> None:
        with self._actions.busy(name):
            self._actions.ask(self._slow[name])

    def _make_commands(self) -> dict[Any, Callable[[Message], str | None]]:
        studio, review = self._studio, self._studio.review

        def plain(action: Callable[[], Any]) -> Callable[[Message], str | None]:
            def run(message: Message) -> str | None:
                result = action()
                return result if isinstance(result, str) else None
            return run

        return {
            'save': lambda message: self._save(''),
            'overwrite': lambda message: self._save(self._found),
            **{name: plain(action) for name, action in (
                ('reload', self._reload), ('export', self._export), ('undo', self._undo),
                ('redo', self._redo), ('split', studio.split), ('merge', studio.merge),
                ('refit', studio.refit), ('refit_all', studio.refit_all),
                ('delete', studio.delete), ('accept', review.accept), ('fix', review.fix),
                ('review_delete', review.delete), ('places_stop', self.places.search.stop),
                ('next', lambda: review.step(1)), ('previous', lambda: review.step(-1)),
                ('next_view', lambda: studio.show_view(self._new().next_view())),
                ('show_coverage', self.places.toggle_coverage),
                ('show_links', self.places.toggle_links))},
            'select': self._select,
            'select_at': lambda message: studio.select_at(_numbers(message, 'pixel', 2)),
            'hide': lambda message: studio.toggle_hidden(_texts(message, 'ids')),
            'lock': lambda message: studio.toggle_lock(_texts(message, 'ids')),
            'edit': self._edit,
            'view': lambda message: studio.show_view(int(_numbers(message, 'view', 1)[0])),
            'draw': lambda message: self._new().draw(
                studio.view, _numbers(message, 'corner', 2), _numbers(message, 'other', 2)),
            'take': lambda message: self._new().take(studio.view, _numbers(message, 'pixel', 2)),
            'forget': lambda message: self._new().forget(message.get('view')),
            'create': lambda message: self._new().create(
                str(message['label']), str(message['class_id']))}

    def _make_slow_commands(self) -> dict[Any, Callable[[], str | None]]:
        found: dict[Any, Callable[[], str | None]] = {
            'check': self._studio.review.check, 'relocalize_here': self._studio.relocalize_here,
            'relocalize_all': self._studio.relocalize_all, 'places': self.places.search.start}
        if self.robot is not None:
            found |= {'relocalize_robot': self.robot.relocalize,
                      'reload_robot': self.robot.reload_map}
        return found

    def _new(self) -> Any:
        if self._studio.new is None:
            raise EditError('there are no views to draw boxes in: start the studio with '
                            '--observations, or with --images and a folder that has poses')
        return self._studio.new

    def _select(self, message: Message) -> None:
        if message.get('joins'):
            self._studio.toggle(str(message['id']))
        else:
            self._studio.document.select([str(message['id'])])

    def _edit(self, message: Message) -> str | None:
        """Set a field of the selected landmark, or move it by some metres."""
        document, field = self._studio.document, str(message['field'])
        if document.selected is None:
            raise EditError('select exactly one landmark first')
        key, one = document.selected
        if field in ('label', 'class_id'):
            values = {field: str(message['value'])}
        elif field in ('center', 'semi_axes', 'angles', 'by'):
            numbers = _numbers(message, 'value', 3)
            values = {'by': lambda: {'center': one.center + numbers},
                      'angles': lambda: {'orientation': Rotation.from_euler(
                          'xyz', numbers, degrees=True).as_quat()}}.get(
                              field, lambda: {field: numbers})()
        else:
            raise EditError(f'{field!r:.60} is no field of a landmark')
        change = document.edit(edits.set_fields, [key], **values,
                               gesture=(field, key, message.get('gesture')))
        return f'{key}: {change.what}' if field in values and change.after else None

    def _undo(self) -> str | None:
        what = self._studio.document.to_undo
        return f'undid: {what}' if self._studio.document.undo() else None

    def _redo(self) -> str | None:
        what = self._studio.document.to_redo
        return f'did again: {what}' if self._studio.document.redo() else None

    def _save(self, found: str) -> str:
        document = self._studio.document
        try:
            document.save(over=found)
        except ChangedOnDiskError as error:
            self._found = error.found
            raise
        self._found = ''
        return f'saved {document.path.name}'

    def _reload(self) -> str:
        self._studio.document.reload()
        self._found = ''
        return f'reloaded {self._studio.document.path.name}; undo takes it back'

    def _export(self) -> str:
        """Write the scene as one page that opens without a server."""
        path = self._studio.document.path.with_suffix('.html')
        try:
            with replace_file(path) as partial:
                partial.write_text(self._actions.server.scene.as_html(), encoding='utf-8')
        except OSError as error:
            raise MapError(f'{path}: cannot be written: {error.strerror}') from error
        return f'wrote {path.name}; open it in a browser'

    # ---- the camera of a person -----------------------------------------------------------------

    def _look(self, person: str, name: str) -> None:
        """Move a person's camera, which takes part of a second, while the next message is done."""
        client, actions, studio = self._find_client(person), self._actions, self._studio

        def look_through() -> None:
            if studio.recording is not None:
                viewpoint.look_through(client, studio.map_from_camera, studio.camera)

        def look_at_robot() -> None:
            if client is not None and self.robot is not None and self.robot.position is not None:
                client.camera.look_at = self.robot.position

        looks: dict[str, Callable[[], None]] = {
            'fly': lambda: actions.look_at_selection(client),
            'overview': lambda: actions.look_at_all(client, False),
            'from_above': lambda: actions.look_at_all(client, True),
            'look_through': look_through, 'look_at_robot': look_at_robot}
        if client is not None and name in looks:
            threading.Thread(target=looks[name], daemon=True).start()

    # ---- what the page shows --------------------------------------------------------------------

    def parts(self) -> dict[str, Any]:
        """Return the parts of the page by name, as JSON can hold them."""
        studio = self._studio
        found = {
            'file': self._file_part(),
            'rows': [[*row, '#{:02x}{:02x}{:02x}'.format(*studio.color_of(row.class_id))]
                     for row in studio.rows()],
            'selection': self._selection_part(),
            'review': {**studio.review.counts(), 'running': self._actions.running},
            'log': self._actions.lines[-_MAX_SHOWN:],
            'test': {**self.places.part(), 'answers': self._answers_part(),
                     'running': self._actions.running,
                     'robot': None if self.robot is None else self.robot.part()}}
        if studio.recording is not None:
            found |= {'view': self._view_part(), 'new': self._new_part()}
        return found

    def _file_part(self) -> dict[str, Any]:
        document = self._studio.document
        return {'name': document.path.name, 'frame': document.frame_id,
                'is_saved': document.is_saved, 'notes': document.notes,
                'undo': document.to_undo, 'redo': document.to_redo,
                'conflict': bool(self._found), 'views': self._studio.views,
                'has_boxes': self._studio.review.has_boxes,
                'images': self._studio.images is not None,
                'classes': sorted({one.class_id for one in document.landmarks.values()})}

    def _selection_part(self) -> dict[str, Any]:
        studio, document = self._studio, self._studio.document
        part: dict[str, Any] = {'ids': document.selection, 'one': None}
        if document.selected is None:
            return part
        key, one = document.selected
        check = studio.review.check_of(key)
        known = {} if check is None else asdict(check)
        sightings = None if self._finder is None else self._finder.find(
            document.landmarks, key, document.is_in_gesture)
        part['one'] = {
            'id': key, 'label': one.label, 'class_id': one.class_id,
            'is_locked': one.marks.is_locked, 'decision': one.marks.decision,
            'center': one.center.tolist(), 'semi_axes': one.semi_axes.tolist(),
            'angles': [round(float(angle), 3) + 0.0 for angle in Rotation.from_quat(
                one.quat_xyzw).as_euler('xyz', degrees=True)],
            'phrases': studio.phrases(), 'note': studio.phrase_note,
            'severity': known.get('severity', 0.0), 'faults': known.get('faults', ()),
            'is_checked': check is not None,
            'support': known.get('support'), 'ratio': known.get('seen_ratio'),
            'sightings': None if sightings is None else [
                [one.view, *(round(float(value), 1) for value in one.bbox_xyxy), one.is_detected]
                for one in sightings]}
        return part

    def _view_part(self) -> dict[str, Any]:
        studio = self._studio
        recording = studio.recording
        assert recording is not None and studio.new is not None
        outlines, selection = studio.outlines(), studio.document.selection
        shown = [one for number, one in enumerate(outlines)
                 if number < _MAX_OUTLINES or one.landmark_id in selection]
        fit, _ = studio.new.fit()
        guess = [] if fit is None else outlines_of(
            {'': Landmark({'label': '', 'class_id': '', **shape_fields(fit.center, fit.basis)})},
            studio.camera, studio.map_from_camera)
        seen = recording.detections.detections_of(studio.view)
        return {
            'view': studio.view, 'camera': studio.camera_name,
            'size': [studio.camera.width, studio.camera.height],
            'boxes': [[*box, name] for box, name in zip(
                seen.bboxes_xyxy.round(1).tolist(), seen.class_ids, strict=True)],
            'outlines': [[one.landmark_id, *_axes_of(one)] for one in shown],
            'guess': [_axes_of(one) for one in guess[:1]],
            'guide': studio.new.guide(studio.view).round(1).tolist()}

    def _new_part(self) -> dict[str, Any]:
        new = self._new()
        fit, doubt = new.fit()
        return {'boxes': sorted(new.boxes.items()), 'class_id': new.class_id, 'doubt': doubt,
                'is_fitted': fit is not None}

    def _answers_part(self) -> list[list[Any]]:
        answers = self._studio.answers[:_MAX_ANSWERS]
        if not answers:
            return []
        return [[one.view, one.verdict, None if one.error_m is None else round(one.error_m, 2),
                 one.result.reason] for one in answers]

    # ---- pictures -------------------------------------------------------------------------------

    def picture(self, path: str) -> Content | None:
        """Return the image of a view, or a crop: /image/ANY/VIEW, /crop/ANY/VIEW/X,Y,X,Y."""
        kind, *words = path.strip('/').split('/')
        studio = self._studio
        try:
            if kind == 'image':
                image = studio.image(int(words[1]))
            elif kind == 'crop' and studio.recording is not None and studio.images is not None:
                box = np.array([float(word) for word in words[2].split(',')])
                view = int(words[1])
                image = None if box.shape != (4,) or not 0 <= view < studio.views else crop_of(
                    studio.recording, studio.images, view, box, _CROP_MARGIN)
                if image is not None and (large := max(image.shape) / _CROP_PX) > 1.0:
                    image = cv2.resize(image, None, fx=1.0 / large, fy=1.0 / large,
                                       interpolation=cv2.INTER_AREA)
            else:
                return None
        except (ValueError, IndexError):
            return None
        except CliplocError as error:
            self._actions.log('refused', str(error))
            return None
        return None if image is None else _jpeg(image)


def _jpeg(image: NDArray[np.uint8]) -> Content:
    done, content = cv2.imencode('.jpg', image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return Content(content.tobytes(), '.jpg', True)


def _axes_of(outline: Outline) -> list[float]:
    """Return an outline's centre, semi-axes [px], and the angle of the first one [deg]."""
    cx, cy, exx, exy, eyy = outline.ellipse
    mean, apart = 0.5 * (exx + eyy), np.hypot(0.5 * (exx - eyy), exy)
    axes = np.sqrt(np.maximum([mean + apart, mean - apart], 0.0))
    return [round(float(value), 1) for value in (
        cx, cy, *axes, np.degrees(0.5 * np.arctan2(2.0 * exy, exx - eyy)))]


def _numbers(message: Message, name: str, count: int) -> NDArray[np.float64]:
    """Return numbers of a message; EditError: they are not that many finite numbers."""
    try:
        values = np.atleast_1d(np.array(message[name], dtype=np.float64))
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise EditError(f'{name}: {message[name]!r:.60} is no list of {count} numbers')
    return values


def _texts(message: Message, name: str) -> list[str] | None:
    """Return texts of a message, None where it lacks them; EditError: they are no list."""
    values = message.get(name)
    if values is None:
        return None
    if not isinstance(values, list):
        raise EditError(f'{name}: {values!r:.60} is no list')
    return list(map(str, values))
