# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of classes, the scale of a map, and verdicts that depend on objects or keyframes."""

from dataclasses import replace

import numpy as np
import pytest
from walk import make_table, see, walk_around

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.report import BY_OBJECTS, Measure
from cliploc_ros.offline.mapping.fitting import fit_ellipsoid
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.triangulation import add_depths
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.vocabulary.vocabulary import size_of_class

QUICK = CheckOptions(max_positions=4, headings=4)


@pytest.fixture(scope='module')
def office(shared_data):
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office/map.yaml')


@pytest.fixture(scope='module')
def report(office):
    return check_map(office, options=QUICK)


def scaled(landmark_map, scale):
    return replace(landmark_map, centers=scale * landmark_map.centers,
                   semi_axes=scale * landmark_map.semi_axes)


@pytest.mark.parametrize('scale', [0.3, 2.6])
def test_the_scale_of_a_map_by_the_sizes_of_its_objects(office, scale):
    report = check_map(scaled(office, scale), options=QUICK)
    assert report.scale == pytest.approx(scale, rel=0.5)
    assert 'times too ' + ('large' if scale > 1.0 else 'small') in report.advice[0]


def test_right_sizes_few_classes_and_views_of_one_side_tell_no_scale(office, report):
    cups = [row for row, name in enumerate(office.class_ids) if name == 'cup']
    one_sided = replace(office, details=(LandmarkDetails(baseline_deg=5.0),) * len(office))
    assert report.scale is None
    for none in (office.select(cups), one_sided):
        assert check_map(scaled(none, 3.0), options=QUICK).scale is None


def test_a_landmark_that_is_too_large_has_a_serious_fault(office):
    row = office.class_ids.index('chair')
    semi_axes = office.semi_axes.copy()
    semi_axes[row] = np.array([0.26, 0.4, 1.61])
    report = check_map(replace(office, semi_axes=semi_axes), options=QUICK)
    found, = (one for one in report.landmarks if one.landmark_id == office.landmark_ids[row])
    assert found.severity >= 1.0 and 'is 3.2 m long, and no chair' in found.faults[0]
    assert size_of_class('unknown thing') is None
    assert size_of_class('Chair') == size_of_class('chair') is not None


def test_a_map_whose_objects_carry_nothing_is_keyframes_only(report):
    missed = Measure(BY_OBJECTS, 0.0, 0.1, False)
    met = Measure('landmarks with a serious fault', 0.0, 0.15, True)
    for measures, verdict in (((met,), 'passed'), ((met, missed), 'keyframes only'),
                              ((met._replace(value=0.8), missed), 'failed')):
        told = replace(report, measures=measures)
        assert told.verdict == verdict
        assert told.passed == (verdict == 'passed')
    accepted = int((report.grid.accepted[report.grid.is_near] > 0).sum())
    positions, = report.localized
    assert f': {accepted} localized by objects, 0 by keyframes only, ' in positions


def longest(views):
    """Return the longest extent of the fit from a sphere around the table's middle [m]."""
    fit = fit_ellipsoid(views, np.arange(len(views.frames)), make_table(2).centers[1],
                        0.1 * np.eye(3))
    return 2.0 * np.linalg.norm(fit.basis, axis=0).max()


def test_the_size_of_a_class_decides_only_where_boxes_of_one_side_do_not():
    # errors of boxes 6 degrees apart look like a bottle that is long along the rays
    table, size = make_table(2).select([1]), size_of_class('bottle')
    assert table.class_ids == ('bottle',)
    table = replace(table, semi_axes=np.array([[0.8, 0.04, 0.13]]),
                    quats_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]]))
    one_side, all_sides = (see(table, walk, noise_px=1.0) for walk in (
        walk_around(40, turn_deg=6.0), walk_around(30)))
    sized, sized_all = (add_depths(make_views(seen), replace(seen, depths=np.full(
        len(seen.classes), np.nan, np.float32))) for seen in (one_side, all_sides))
    assert longest(make_views(one_side)) > size.most_m > longest(sized)
    assert longest(sized_all) == pytest.approx(1.6, rel=0.03)
