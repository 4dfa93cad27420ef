# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Report the map that the demo built: on the terminal, and as a section of the page."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape

from cliploc_ros.demo.map_review import NEAR_M, MapReview
from cliploc_ros.evaluation.summary import LIMITS_M, Summary

PICTURE = 'built_map.png'
_SUCCESS_COLUMNS = ('', *(f'within {limit:g} m' for limit in LIMITS_M), 'median error', 'accepted',
                    'false accepts')


def console_lines(review: MapReview) -> Iterator[str]:
    """Yield the comparison of the built map with the room."""
    yield review.summary()
    for row, reason in review.missed.items():
        yield f'  missed: {review.objects[row].object_id}: {reason}'
    for landmark, instead in review.false.items():
        yield f'  false: {review.landmark_map.landmark_ids[landmark]}: {instead}'


def success_lines(summaries: Mapping[str, Summary]) -> Iterator[str]:
    """Yield the table of success in both maps."""
    rows = [_SUCCESS_COLUMNS, *(_success_cells(*item) for item in summaries.items())]
    for row in rows:
        yield '  '.join(cell.ljust(13) for cell in row).rstrip()


def section(review: MapReview, summaries: Mapping[str, Summary], images: int) -> str:
    """Return the section of the page."""
    return '\n'.join([
        '<h2>The map</h2>',
        f'<p><code>build_map</code> built it from {images} images of a mapping walk, with the '
        'poses of that walk. The wake-ups come later: objects have moved, and the light has '
        'changed.</p>',
        f'<p><b>{escape(review.summary())}.</b> An object is found if a landmark of its class '
        f'lies within {NEAR_M * 100:.0f} cm of it. All other landmarks are false.</p>',
        f'<figure><img src="{PICTURE}" alt="built map and true objects from three sides">'
        '<figcaption>Found, missed and false objects. The dotted line is the mapping walk.'
        '</figcaption></figure>',
        '<p>One look at each image of the wake-ups, in the built map and in the true map:</p>',
        _table(_SUCCESS_COLUMNS, (_success_cells(*item) for item in summaries.items())),
        *_losses(review), _all_found(review), '<h2>The wake-ups in this map</h2>'])


def _success_cells(name: str, summary: Summary) -> tuple[str, ...]:
    count = summary.errors_m.size
    return (name, *(f'{summary.success(limit):.2f}' for limit in LIMITS_M),
            f'{summary.median_error_m:.3f} m', f'{summary.accepted.sum()} of {count}',
            str(summary.false_accepts()))


def _losses(review: MapReview) -> Iterator[str]:
    """Yield the tables of missed and false objects."""
    if review.missed:
        yield '<h3>Missed objects</h3>'
        yield _table(('object', 'label', 'why'), (
            (review.objects[row].object_id, review.objects[row].label, reason)
            for row, reason in review.missed.items()))
    if review.false:
        yield '<h3>False objects</h3>'
        yield _table(('landmark', 'label', 'what is there'), (
            (review.landmark_map.landmark_ids[landmark], review.landmark_map.labels[landmark],
             instead) for landmark, instead in review.false.items()))


def _all_found(review: MapReview) -> str:
    rows = [(review.objects[one.object_row].object_id, review.objects[one.object_row].label,
             review.landmark_map.landmark_ids[one.landmark],
             review.landmark_map.labels[one.landmark], f'{one.offset_m * 100:.1f} cm',
             f'{one.size_ratio - 1:+.0%}')
            for one in sorted(review.found, key=lambda one: -one.offset_m)]
    return ('<details><summary>All found objects, the least accurate first</summary>'
            + _table(('object', "a person's label", 'landmark', "the map's label", 'off by',
                      'size'), rows) + '</details>')


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return '<tr>' + ''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells) + '</tr>'

    return '<table>' + line(headings, 'th') + ''.join(line(row, 'td') for row in rows) + '</table>'
