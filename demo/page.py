# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Report the demo's wake-ups: a table on the terminal, and a page with the pictures."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from cliploc_ros.files.storage import write_text
from cliploc_ros.offline.page import figure, first_screen, fold, page, table, tiles, verdict
from demo.review import WRONG_M, Judged, Review

TOP_VIEW = 'top_view.png'
#: Pattern of the wake-ups' pictures.
PICTURES = 'wake_up_??.png'

# Columns of the first screen.
_BRIEF_COLUMNS = (0, 2, 4, 6, 7)
# Heading and width on the terminal.
_COLUMNS = (('', 3), ('image at', 8), ('answer', 8), ('score', 6), ('landmarks', 9),
            ('x y z [m]', 18), ('error', 15), ('answer time', 11), ('stages', 0))
_BRIEF = [_COLUMNS[column][0] for column in _BRIEF_COLUMNS]

_SYNTHETIC = """\
<p class="note"><b>This world is synthetic.</b> A program rendered the room, its objects and the
images. Detector and CLIP are small networks trained on renders of similar rooms. Nodes, messages
and search are the same as on a robot. The page shows that the system works end to end. It does
<em>not</em> show how well the system recognizes real objects in real light. To measure that, run
the nodes on your own recordings.</p>"""

_REAL = """\
<p class="note"><b>These images are real:</b> {recording}. The map was built from other images of
the same recording, by the detector and CLIP that also run here.</p>"""

_HOW = """\
<p class="note">The two nodes published the boxes, the hypotheses and the numbers in the table. The
errors are relative to the recording's ground truth, which the nodes do not receive. The nodes do
not publish the matches of boxes and landmarks. For the pictures the demo therefore repeats the
search on the same detections with the same code, networks, options and seed, and compares its pose
with the published pose ({repeated}).</p>"""

_LIST = """\
<p class="note">CLIP is the cosine similarity of crop and label, rank its place among all labels of
the map, and IoU the overlap of box and projected landmark. ✓ and ✗ compare a match with the object
that the renderer drew there. A ✗ can also mean that the object was moved after mapping, or is not
in the map.</p>"""


def rig_section(cameras: Sequence[str], alone: int, count: int) -> str:
    """Return the page's note on a rig: how many wake-ups its first camera alone would accept."""
    return (f'<p class="note">The robot has {len(cameras)} cameras, {escape(", ".join(cameras))}, '
            'and does not turn. Its pose is that of the first camera. With this camera alone, '
            f'{alone} of {count} wake-ups would be accepted.</p>')


def picture_name(judged: Judged) -> str:
    """Return the file name of a wake-up's picture."""
    return PICTURES.replace('??', f'{judged.number:02d}')


def console_header() -> str:
    """Return the headings of the table."""
    return _line([heading for heading, _ in _COLUMNS])


def console_row(judged: Judged) -> str:
    """Return a wake-up as a line of the table."""
    return _line(_cells(judged))


def summary(judged: Sequence[Judged]) -> str:
    """Summarize all wake-ups in one line."""
    accepted = [case for case in judged if case.wake_up.accepted]
    wrong = sum(case.is_wrong for case in accepted)
    errors = [case.error[0] for case in accepted if case.error is not None]
    text = (f'{len(judged)} wake-ups: {len(accepted)} accepted, {len(judged) - len(accepted)} '
            f'refused, {wrong or "none"} wrong by more than {WRONG_M:g} m')
    if errors:
        text += f'; error {np.median(errors):.3f} m (median), {max(errors):.3f} m at most'
    return text + f'; answer time {np.median([case.wake_up.answer_s for case in judged]):.2f} s ' \
        '(median)'


def write_page(folder: Path, reviews: Sequence[Review], method: str, section: str = '',
               recording: str = '') -> Path:
    """Write the page that shows all pictures; return its file.

    The section is HTML to put before the wake-ups. ``recording`` names a real recording.
    """
    judged = [review.judged for review in reviews]
    accepted = [case for case in judged if case.wake_up.accepted]
    wrong = sum(case.is_wrong for case in accepted)
    errors = [case.error[0] for case in accepted if case.error is not None]
    repeated = sum(review.repeated for review in reviews)
    how = _HOW.format(repeated=f'equal in {repeated} of {len(reviews)} cases')
    rows = [[(cell, cell) if cell in ('accepted', 'refused') else cell for cell in _cells(case)]
            for case in judged]
    pictures = [figure(picture_name(case), f'“{case.wake_up.message}”',
                       f'wake-up {case.number}: {case.verdict}') for case in judged]
    numbers = [(f'{len(accepted)} of {len(judged)}', 'wake-ups accepted', bool(accepted)),
               (str(wrong), f'wrong by more than {WRONG_M:g} m', not wrong)]
    if errors:
        numbers.append((f'{100 * np.median(errors):.1f} cm', 'median position error', not wrong))
    page_file = folder / 'index.html'
    write_text(page_file, page(
        'cliploc_ros: a robot wakes up', first_screen(
            [verdict(f'{summary(judged)}.', not wrong), tiles(numbers),
             _REAL.format(recording=escape(recording)) if recording else _SYNTHETIC,
             '<h2>Wake-ups</h2>', table(_BRIEF, ([row[column] for column in _BRIEF_COLUMNS]
                                                 for row in rows))],
            [figure(TOP_VIEW, 'Top view of the map. A line joins each estimate to its ground '
                    'truth. Refused poses were not published.', 'map with the estimated poses')]),
        section,
        fold(f'All figures; method {method}', table([name for name, _ in _COLUMNS], rows)),
        # several cameras have pictures without a list of matches
        fold('How to read the pictures', how, '' if any(review.beside for review in reviews)
             else _LIST), *pictures))
    return page_file


def _cells(judged: Judged) -> list[str]:
    """Return the cells of a wake-up; the error of a refused pose is in parentheses."""
    wake_up = judged.wake_up
    position = error = '–'
    if wake_up.accepted and judged.pose is not None:
        position = ' '.join(f'{value:.2f}' for value in judged.pose[:3, 3])
    if judged.error is not None:
        error = f'{judged.error[0]:.3f} m {judged.error[1]:.1f}°'
        error = error if wake_up.accepted else f'({error})'
    stages = ', '.join(f'{stage} {ms} ms' for stage, ms in wake_up.stage_ms.items())
    return [str(judged.number), f'{judged.time_s:.1f} s',
            'accepted' if wake_up.accepted else 'refused', f'{wake_up.score:.2f}',
            str(wake_up.landmarks), position, error, f'{wake_up.answer_s:.2f} s', stages]


def _line(cells: Sequence[str]) -> str:
    return '  '.join(cell.ljust(width) for cell, (_, width) in zip(cells, _COLUMNS, strict=True)
                     ).rstrip()
