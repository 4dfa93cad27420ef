# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page that compares methods: the best method, the table and all figures."""

from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.files.storage import write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation.summary import Summary, find_best

PAGE = 'report.html'
_TOP_VIEW = 'top_view'
# Columns of the first screen: method, success, accepted, false accepts.
_BRIEF = (0, 1, 2, 5, 7)
CAPTIONS = {
    _TOP_VIEW: 'Top view of the map. A line joins each estimate of this method to the true pose.',
    'success_over_threshold': 'Share of poses, accepted or not, within a distance of the truth.',
    'precision_over_recall': 'Precision and recall for all thresholds of the confidence.',
    'best_iteration': 'Iteration that found the best pose.',
    'success_over_iterations': 'Success over the number of iterations.'}


def write_report(folder: Path, summaries: Sequence[Summary], rows: Sequence[Sequence[str]],
                 remarks: Sequence[str], pictures: Sequence[Path],
                 about: Sequence[tuple[str, str]]) -> None:
    """Write the page. It embeds the pictures, which are PNG files.

    `rows` are those of the table, its header first; `about` names and values of input and options.
    """
    best = find_best(summaries)
    wrong, count = best.false_accepts(), best.errors_m.size
    said = html.verdict(f'{best.method} is the best of {len(summaries)} methods on '
                        f'{len(best.queries)} images' if len(summaries) > 1 else
                        f'{best.method} on {len(best.queries)} images', not wrong)
    numbers = [(f'{100 * best.success(1.0):.0f} %', 'of the poses within 1 m of the truth', True)]
    if not best.is_given:
        numbers += [
            (f'{int(best.accepted.sum())} of {count}', 'accepted', bool(best.accepted.any())),
            (str(wrong), 'accepted, but wrong by more than 1 m', not wrong)]
    drawn = {picture.stem: html.figure(picture.read_bytes(), CAPTIONS[picture.stem], picture.stem)
             for picture in pictures}
    head, *brief = [[row[column] for column in _BRIEF] for row in rows]
    top_view = drawn.pop(_TOP_VIEW, '')
    write_text(folder / PAGE, html.page(
        'Evaluation',
        html.first_screen([said, html.tiles(numbers), html.table(head, brief)], [top_view]),
        html.fold('Complete table', html.table(rows[0], rows[1:]), *map(html.note, remarks)),
        html.fold('Input and options', html.table(('', ''), about)),
        html.fold('Figures', html.side_by_side(drawn.values()), is_open=True)))
