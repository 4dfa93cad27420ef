# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of all rooms: tables, maps from above with what became of each image, and failures."""

import io
from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.evaluation.figures import draw_map
from cliploc_ros.files.page import ACCEPTED, FAINT, MISLED, REFUSED
from cliploc_ros.files.storage import write_text
from studies.rooms.asking import BOTH, KEYFRAMES, KNOWN, NOTHING, OBJECTS, WAYS, Answers, Outcome
from studies.rooms.rooms import Room
from studies.rooms.tables import grouped

_STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 1200px;
  padding: 0 1rem }
img { max-width: 100% } figure { margin: 1.5rem 0 } figcaption { font-size: 14px; color: #555 }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums }
th, td { text-align: left; padding: .2rem .7rem; border-bottom: 1px solid #ddd }
summary { font-weight: 600; cursor: pointer; margin: .8rem 0 } .row { display: flex; gap: 1rem }
.row figure { flex: 1 }
"""
_VERDICTS = {'accepted, right': ACCEPTED, 'refused, right within 1 m': REFUSED,
             'refused, no right pose': FAINT, 'accepted, wrong': MISLED}
_ERRORS_M = np.linspace(0.0, 1.5, 76)
_COLORS = dict(zip(WAYS, ('#E69F00', '#56B4E9', '#0072B2', '#222222'), strict=True))
_FAILURES, _IMAGE_PX, _JPEG_QUALITY = 3, 380, 70


def write_page(path: Path, answers: Sequence[Answers], rooms: Sequence[Room], text: str) -> None:
    """Write the page: pictures of each room, and the tables (Markdown) folded below."""
    parts = ['<!DOCTYPE html>', '<html lang="en">', '<meta charset="utf-8">',
             '<meta name="viewport" content="width=device-width">', '<title>Rooms</title>',
             f'<style>{_STYLE}</style>', '<h1>Rooms</h1>']
    failures, *sections = text.split('## ')
    parts += [f'<p>{escape(line)}</p>' for line in failures.splitlines() if line]
    for section in sections:
        heading, _, lines = section.partition('\n')
        is_open = ' open' if heading == 'Rooms' else ''
        parts.append(f'<details{is_open}><summary>{escape(heading)}</summary>'
                     f'{_html_table(lines)}</details>')
    for room in rooms:
        its = [one for one in answers if one.task.room == room.name and one.outcomes]
        if its:
            parts.append(f'<h2>{escape(room.name)}</h2>')
            parts += [_picture(_curves(its), 'Share of images whose best pose is within a '
                               'distance of the truth, over all splits.'),
                      _picture(_top_views(its, room), 'Cameras from above, by what became of '
                               'their image without vertical and depth; landmarks of the map of '
                               'that part.'),
                      *_failures(its, room)]
    write_text(path, '\n'.join([*parts, '</html>', '']))


def _html_table(markdown: str) -> str:
    lines = [[cell.strip() for cell in line.strip().strip('|').split('|')]
             for line in markdown.strip().splitlines()]
    head, rows = lines[0], lines[2:]
    return ('<table><tr>' + ''.join(f'<th>{escape(cell)}</th>' for cell in head) + '</tr>'
            + ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>'
                      for row in rows) + '</table>')


def _picture(figure: Figure, caption: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=100)
    data = b64encode(buffer.getvalue()).decode('ascii')
    return (f'<figure><img alt="" src="data:image/png;base64,{data}">'
            f'<figcaption>{escape(caption)}</figcaption></figure>')


def _curves(answers: Sequence[Answers]) -> Figure:
    """Draw the share of right poses over the limit of the error, for each split."""
    here = [one for answer in answers for one in answer.outcomes if one.is_here]
    kinds = list(dict.fromkeys(one.kind for one in here))
    figure = Figure(figsize=(3.0 * len(kinds), 3.2), layout='constrained')
    for column, kind in enumerate(kinds, start=1):
        axes = figure.add_subplot(1, len(kinds), column)
        some = [one for one in here if one.kind == kind and one.known in (NOTHING, KNOWN[-1])]
        for (way, known), its in grouped(some, 'way', 'known'):
            errors = np.array([one.error_m for one in its])
            axes.plot(_ERRORS_M, [np.mean(errors < limit) for limit in _ERRORS_M],
                      color=_COLORS[way], linestyle='-' if known == NOTHING else '--',
                      label=way if known == NOTHING else f'{way}, {known}')
        axes.set(title=kind, xlabel='error [m]', ylim=(0.0, 1.02), xlim=(0.0, 1.5))
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=4, frameon=False, fontsize=9)
    return figure


def _verdict(one: Outcome) -> str:
    right = one.error_m < RIGHT_M
    return list(_VERDICTS)[(0 if right else 3) if one.accepted else (1 if right else 2)]


def _top_views(answers: Sequence[Answers], room: Room) -> Figure:
    """Draw one part of each split from above: by objects, and by keyframes."""
    kinds = list({one.task.kind: one for one in answers}.values())
    figure = Figure(figsize=(3.4 * len(kinds), 7.4), layout='constrained')
    poses = room.detections.map_from_camera[:, :3, 3]
    for row, way in enumerate((OBJECTS, KEYFRAMES)):
        for column, answer in enumerate(kinds):
            axes: Axes = figure.add_subplot(2, len(kinds), 1 + row * len(kinds) + column)
            if answer.landmark_map is not None:
                draw_map(axes, answer.landmark_map)
            for one in answer.outcomes:
                if one.is_here and one.way == way and one.known == NOTHING:
                    axes.plot(*poses[one.number, :2], '.', color=_VERDICTS[_verdict(one)],
                              markersize=5, zorder=6)
            axes.set(aspect='equal', title=f'{answer.task.part}, {way}')
            axes.autoscale_view()
    figure.legend(handles=[Line2D([], [], color=color, marker='.', linestyle='none', label=name)
                           for name, color in _VERDICTS.items()],
                  loc='outside lower center', ncols=4, frameon=False)
    return figure


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
        data = b64encode(cv2.imencode('.jpg', small[..., ::-1], [
            cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()).decode('ascii')
        images.append(f'<figure><img alt="" src="data:image/jpeg;base64,{data}"><figcaption>'
                      f'image {one.number}, {escape(one.part)}: '
                      + escape(one.reason or f'accepted, {one.error_m:.1f} m off') +
                      '</figcaption></figure>')
    if images:
        yield ('<h3>Images without a right pose by both, the most confident first</h3>'
               f'<div class="row">{"".join(images)}</div>')
