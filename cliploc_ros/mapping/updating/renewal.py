# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The new map: what stays, what is fitted again, what moves, what is added and what goes.

A landmark keeps its id, labels and classes. In its place, it also keeps its ellipsoid, unless the
recording knows it better: then the centre is the mean of both, each weighted by its inverse
variance, and the shape is the new one. A centre that differs significantly was nudged: the new one
counts alone. An ellipsoid without position_sigma was made by hand, and stays.
"""

from dataclasses import replace

import numpy as np

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.mapping.updating.alignment import deviations
from cliploc_ros.mapping.updating.fates import Fates
from cliploc_ros.mapping.updating.known import Known, ellipsoid_numbers
from cliploc_ros.mapping.updating.objects import Objects
from cliploc_ros.mapping.updating.options import UpdateOptions


def renew(old: LandmarkMap, known: Known, objects: Objects, fates: Fates,
          class_names: tuple[str, ...], options: UpdateOptions) -> LandmarkMap:
    """Return the new map: the old landmarks that are left, in their order, then new ones.

    Parameters
    ----------
    class_names : tuple of str
        Of the recording.
    """
    centers, details = old.centers.copy(), list(known.details)
    semi_axes, quats = old.semi_axes.copy(), old.quats_xyzw.copy()
    new_axes, new_quats = ellipsoid_numbers(objects.landmarks.bases)
    placed = _refitted(known, objects, fates, options)
    sigmas = objects.refits.sigmas
    for row in np.concatenate([fates.confirmed, fates.moved]):
        number = fates.objects[row]
        details[row] = _with_views(details[row], objects, number)
        weight = 1.0 if row in fates.moved else placed.get(int(row), 0.0)
        if weight > 0.0:
            centers[row] += weight * (objects.landmarks.centers[number] - centers[row])
            semi_axes[row], quats[row] = new_axes[number], new_quats[number]
            sigma = sigmas[number] if weight == 1.0 else np.sqrt(weight) * sigmas[number]
            details[row] = replace(details[row], position_sigma=float(sigma))
    for row in fates.moved:
        details[row] = _of_object(details[row], objects, fates.objects[row])
    kept = np.setdiff1d(np.arange(len(old)), fates.missing)
    names = tuple(class_names[number] for number in objects.landmarks.classes[fates.new])
    every = [details[row] for row in kept] + [
        _of_object(objects.given[number], objects, number) for number in fates.new]
    return LandmarkMap(
        old.frame_id,
        tuple(old.landmark_ids[row] for row in kept) + _unused_ids(names, old.landmark_ids),
        tuple(old.labels[row] for row in kept) + names,
        tuple(old.class_ids[row] for row in kept) + names,
        np.concatenate([centers[kept], objects.landmarks.centers[fates.new]]),
        np.concatenate([semi_axes[kept], new_axes[fates.new]]),
        np.concatenate([quats[kept], new_quats[fates.new]]),
        tuple(every) if any(one != LandmarkDetails() for one in every) else ())


def _refitted(known: Known, objects: Objects, fates: Fates, options: UpdateOptions
              ) -> dict[int, float]:
    """Return the weight of the new centre for the confirmed landmarks that are fitted again."""
    rows = np.array([row for row in fates.confirmed
                     if known.details[row].position_sigma is not None
                     and objects.refits.is_known[fates.objects[row]]], dtype=np.int64)
    numbers = fates.objects[rows]
    nudged = deviations(known.select(rows), objects.refits.select(numbers),
                        np.arange(len(rows))) > options.least_move_sigmas
    old_sigmas, new_sigmas = known.sigmas[rows], objects.refits.sigmas[numbers]
    weights = np.where(nudged, 1.0, old_sigmas ** 2 / (old_sigmas ** 2 + new_sigmas ** 2))
    better = nudged | (new_sigmas < old_sigmas)
    return dict(zip(rows[better].tolist(), weights[better].tolist(), strict=True))


def _with_views(details: LandmarkDetails, objects: Objects, number: int) -> LandmarkDetails:
    """Return what is known of a landmark in its place with what the recording adds."""
    sight, evidence = objects.sight, objects.evidence
    seen, expected = int(sight.seen_frames[number]), int(sight.expected_frames[number])
    support, ratio = details.support or 0, details.seen_ratio
    if support and ratio:
        expected += round(support / ratio)
    return replace(
        details, support=support + seen, seen_ratio=min(1.0, (support + seen) / max(1, expected)),
        baseline_deg=max(details.baseline_deg or 0.0, float(evidence.baseline_deg[number])),
        last_seen=max(details.last_seen or 0.0, float(evidence.last_seen[number])))


def _of_object(details: LandmarkDetails, objects: Objects, number: int) -> LandmarkDetails:
    """Return what is known of a landmark in a new place: what the recording says."""
    sight, evidence = objects.sight, objects.evidence
    return replace(
        details, position_sigma=float(evidence.position_sigma[number]),
        support=int(evidence.support[number]),
        seen_ratio=float(min(1.0, sight.seen_ratio[number])),
        baseline_deg=float(evidence.baseline_deg[number]),
        last_seen=max(0.0, float(evidence.last_seen[number])))


def _unused_ids(names: tuple[str, ...], used: tuple[str, ...]) -> tuple[str, ...]:
    """Return an id for each class name that no landmark of the old map has."""
    taken, ids = set(used), []
    for name in names:
        word = ''.join(char if char.isalnum() else '_' for char in name)
        number = 1
        while f'{word}_{number}' in taken:
            number += 1
        ids.append(f'{word}_{number}')
        taken.add(ids[-1])
    return tuple(ids)
