# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of all rooms: tables, maps from above with what became of each image, and failures."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.files.storage import write_text
from cliploc_ros.offline.evaluation.figures import draw_map, png_of
from cliploc_ros.offline.page import (
    ACCEPTED,
    FAINT,
    MISLED,
    REFUSED,
    figure,
    fold,
    note,
    page,
    side_by_side,
    table,
)
from studies.rooms.asking import BOTH, KEYFRAMES, KNOWN, NOTHING, OBJECTS, WAYS, Answers, Outcome
from studies.rooms.rooms import Room
from studies.rooms.tables import grouped

_VERDICTS = {'accepted, right': ACCEPTED, 'refused, right within 1 m': REFUSED,
             'refused, no right pose': FAINT, 'accepted, wrong': MISLED}
_ERRORS_M = np.linspace(0.0, 1.5, 76)
_COLORS = dict(zip(WAYS, ('#E69F00', '#56B4E9', '#0072B2', '#222222'), strict=True))
_FAILURES, _IMAGE_PX, _JPEG_QUALITY, _DPI = 3, 380, 70, 100


def write_page(path: Path, answers: Sequence[Answers], rooms: Sequence[Room], text: str) -> None:
    """Write the page: pictures of each room, and the tables (Markdown) folded below."""
    failures, *sections = text.split('## ')
    parts = [note(line) for line in failures.splitlines() if line]
    for section in sections:
        heading, _, lines = section.partition('\n')
        cells = [[cell.strip() for cell in line.strip().strip('|').split('|')]
                 for line in lines.strip().splitlines()]
        parts.append(fold(heading, table(cells[0], cells[2:]), is_open=heading == 'Rooms'))
    for room in rooms:
        its = [one for one in answers if one.task.room == room.name and one.outcomes]
        if its:
            parts.append(fold(
                room.name,
                figure(png_of(_curves(its), _DPI), 'Share of images whose best pose is within a '
                       'distance of the truth, over all splits.'),
                figure(png_of(_top_views(its, room), _DPI), 'Cameras from above, by what became '
                       'of their image without vertical and depth; landmarks of the map of that '
                       'part.'), *_failures(its, room), is_open=True))
    write_text(path, page('Rooms', *parts))


def _curves(answers: Sequence[Answers]) -> Figure:
    """Draw the share of right poses over the limit of the error, for each split."""
    here = [one for answer in answers for one in answer.outcomes if one.is_here]
    kinds = list(dict.fromkeys(one.kind for one in here))
    drawn = Figure(figsize=(3.0 * len(kinds), 3.2), layout='constrained')
    for column, kind in enumerate(kinds, start=1):
        axes = drawn.add_subplot(1, len(kinds), column)
        some = [one for one in here if one.kind == kind and one.known in (NOTHING, KNOWN[-1])]
        for (way, known), its in grouped(some, 'way', 'known'):
            errors = np.array([one.error_m for one in its])
            axes.plot(_ERRORS_M, [np.mean(errors < limit) for limit in _ERRORS_M],
                      color=_COLORS[way], linestyle='-' if known == NOTHING else '--',
                      label=way if known == NOTHING else f'{way}, {known}')
        axes.set(title=kind, xlabel='error [m]', ylim=(0.0, 1.02), xlim=(0.0, 1.5))
        axes.grid(alpha=0.3)
    handles, labels = drawn.axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc='outside lower center', ncols=4, frameon=False, fontsize=9)
    return drawn


def _verdict(one: Outcome) -> str:
    right = one.error_m < RIGHT_M
    return list(_VERDICTS)[(0 if right else 3) if one.accepted else (1 if right else 2)]


def _top_views(answers: Sequence[Answers], room: Room) -> Figure:
    """Draw one part of each split from above: by objects, and by keyframes."""
    kinds = list({one.task.kind: one for one in answers}.values())
    drawn = Figure(figsize=(3.4 * len(kinds), 7.4), layout='constrained')
    poses = room.detections.map_from_camera[:, :3, 3]
    for row, way in enumerate((OBJECTS, KEYFRAMES)):
        for column, answer in enumerate(kinds):
            axes: Axes = drawn.add_subplot(2, len(kinds), 1 + row * len(kinds) + column)
            if answer.landmark_map is not None:
                draw_map(axes, answer.landmark_map)
            for one in answer.outcomes:
                if one.is_here and one.way == way and one.known == NOTHING:
                    axes.plot(*poses[one.number, :2], '.', color=_VERDICTS[_verdict(one)],
                              markersize=5, zorder=6)
            axes.set(aspect='equal', title=f'{answer.task.part}, {way}')
            axes.autoscale_view()
    drawn.legend(handles=[Line2D([], [], color=color, marker='.', linestyle='none', label=name)
                           for name, color in _VERDICTS.items()],
                  loc='outside lower center', ncols=2, frameon=False)
    return drawn


def _failures(answers: Sequence[Answers], room: Room) -> Iterator[str]:
    """Yield images whose best pose by both is wrong, with what was said."""
    wrong = [one for answer in answers for one in answer.outcomes
             if one.is_here and one.way == BOTH and one.known == NOTHING
             and one.error_m >= RIGHT_M]
    wrong.sort(key=lambda one: -one.confidence)
    images = []
    for one in list({one.number: one for one in reversed(wrong)}.values())[::-1][:_FAILURES]:
        image_rgb, _ = room.raws[one.number].color()
        scale = _IMAGE_PX / image_rgb.shape[1]
        small = cv2.resize(image_rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode('.jpg', small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        images.append(figure(jpeg.tobytes(), f'image {one.number}, {one.part}: ' + (
            one.reason or f'accepted, {one.error_m:.1f} m off')))
    if images:
        yield '<h2>Images without a right pose by both, the most confident first</h2>'
        yield side_by_side(images)
