# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result of checking a map as one web page, with the map seen along its third axis."""

from html import escape

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.mapping.checking import MIN_MATCHES, CheckedLandmark, CheckedMap

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; color: #222 }
table { border-collapse: collapse; width: 100% } td, th { padding: .2rem .6rem; text-align: left }
tr:nth-child(even) { background: #f4f4f4 } .bad { color: #b00020 }
svg { width: 100%; height: auto }
"""
_COLUMNS = ('landmark', 'support', 'seen', 'baseline [deg]', 'deviation [m]', 'offset [m]',
            'problems')
_MARGIN_M = 0.5
_GOOD, _BAD = '#1b7f4b', '#b00020'


def check_page(landmark_map: LandmarkMap, checked: CheckedMap,
               camera_positions: NDArray[np.float64] | None = None) -> str:
    """Return a page of HTML.

    Parameters
    ----------
    landmark_map : LandmarkMap
    checked : CheckedMap
    camera_positions : ndarray (F, 3), optional
        Where the frames were taken [m]; red where a frame shows too few landmarks.
    """
    summary = ''.join(f'<p>{escape(line)}</p>' for line in checked.lines()
                      if not line.startswith('  '))
    head = ''.join(f'<th>{name}</th>' for name in _COLUMNS)
    rows = ''.join(_row(one) for one in checked.landmarks)
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Map check</title>'
            f'<style>{_STYLE}</style><h1>Map check</h1>{summary}'
            f'{_top_view(landmark_map, checked, camera_positions)}'
            f'<table><tr>{head}</tr>{rows}</table></html>\n')


def _row(one: CheckedLandmark) -> str:
    cells = (one.landmark_id, _text(one.support, '{:d}'), _text(one.seen_ratio, '{:.0%}'),
             _text(one.baseline_deg, '{:.0f}'), _text(one.position_sigma, '{:.3f}'),
             _text(one.offset_m, '{:.3f}'), '; '.join(one.problems))
    kind = ' class="bad"' if one.problems else ''
    return f'<tr{kind}>' + ''.join(f'<td>{escape(cell)}</td>' for cell in cells) + '</tr>'


def _text(value: float | None, form: str) -> str:
    return '' if value is None else form.format(value)


def _top_view(landmark_map: LandmarkMap, checked: CheckedMap,
              camera_positions: NDArray[np.float64] | None) -> str:
    """Return a drawing of the landmarks and of the camera's way."""
    places = landmark_map.centers[:, :2]
    way = np.empty((0, 2)) if camera_positions is None else camera_positions[:, :2]
    low = np.concatenate([places, way]).min(axis=0) - _MARGIN_M
    high = np.concatenate([places, way]).max(axis=0) + _MARGIN_M
    width, height = high - low
    # the y axis of a picture points down, the map's points up
    parts = [_dot(x - low[0], high[1] - y, 0.02, _GOOD if count >= MIN_MATCHES else _BAD, '')
             for (x, y), count in zip(way, checked.landmarks_in_frames, strict=False)]
    parts += [_dot(x - low[0], high[1] - y, radius, _BAD if one.problems else '#3465a4',
                   f'{one.landmark_id}: {"; ".join(one.problems) or "good"}')
              for (x, y), radius, one in zip(places, landmark_map.semi_axes.mean(axis=1),
                                             checked.landmarks, strict=True)]
    return f'<svg viewBox="0 0 {width:.3f} {height:.3f}">{"".join(parts)}</svg>'


def _dot(x: float, y: float, radius: float, colour: str, title: str) -> str:
    return (f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{radius:.3f}" fill="{colour}" '
            f'fill-opacity=".6"><title>{escape(title)}</title></circle>')
