# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure tags: ``python -m studies.tags images|accept ...``.

images FOLDER...: tags are painted into real images (12 to 200 px, blurred, tilted up to 75
degrees): recall, corner error, processor time, false ids without tags, accepted flips; beside
pupil-apriltags if it is installed. accept QUERIES MAP: tags in front of the cameras of recorded
queries with real boxes: right, moved, of another size, boards.
"""

import argparse
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.command import run_command
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import (
    SAME_ANSWER,
    make_transform,
    pose_error,
    quaternion_from_transform,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.tags import SQUARE, Tag
from cliploc_ros.core.observation import Detections, Observation, SeenTags
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.tag_detection import detect_tags
from cliploc_ros.offline.datasets.observations import load_queries
from cliploc_ros.offline.evaluation.trials import make_queries
from studies.reports import table

Array = NDArray[Any]
_NOTHING = Detections(np.empty((0, 4)), (), np.empty(0))
_OPTIONS = RelocalizerOptions(matching='class')
# Optical axes into the axes of a map whose x axis the camera looks along.
_POSE = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
_SIZE_M, _FAMILY, _TEXTURE_PX = 0.16, 'tag36h11', 32


def pattern_of(tag: Tag) -> tuple[Array, int]:
    """Return the picture of a tag with its white margin, and the modules of the black square."""
    is_april = tag.family.startswith('tag')
    name = f'DICT_APRILTAG_{tag.family[3:]}' if is_april else tag.family
    patterns = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    modules = patterns.markerSize + 2
    picture = np.full((_TEXTURE_PX * (modules + 2),) * 2, 255, np.uint8)
    inner = cv2.aruco.generateImageMarker(patterns, tag.number, _TEXTURE_PX * modules)
    picture[_TEXTURE_PX:-_TEXTURE_PX, _TEXTURE_PX:-_TEXTURE_PX] = np.rot90(inner, 2 * is_april)
    return picture, modules


def painted(gray: Array, tag: Tag, camera_from_tag: Array, camera: Camera, blur_px: float,
            levels: tuple[float, float], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return an image with a tag of a size, a blur and grey levels, and its true corners."""
    picture, modules = pattern_of(tag)

    def projected(points: Array) -> Array:
        inside = points @ camera_from_tag[:3, :3].T + camera_from_tag[:3, 3]
        return camera.project_normalized(inside[:, :2] / inside[:, 2:])
    corners = projected(tag.size * SQUARE)
    outer = projected(tag.size * (modules + 2) / modules * SQUARE)
    low = np.maximum(np.floor(outer.min(axis=0) - 4 - 3 * blur_px).astype(int), 0)
    high = np.minimum(np.ceil(outer.max(axis=0) + 5 + 3 * blur_px).astype(int),
                      [gray.shape[1], gray.shape[0]])
    fine = int(np.clip(np.ceil(200 / np.linalg.norm(outer[1] - outer[0])), 3, 12))
    side = picture.shape[0]
    source = np.array([[-0.5, -0.5], [side - 0.5, -0.5], [side - 0.5, side - 0.5],
                       [-0.5, side - 0.5]], np.float32)
    warp = cv2.getPerspectiveTransform(
        source, ((outer - low + 0.5) * fine - 0.5).astype(np.float32))
    shape = tuple(int(length) for length in (high - low) * fine)
    shrunk = side / (np.linalg.norm(outer[1] - outer[0]) * fine)
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.4 * shrunk) if shrunk > 1.5 else picture
    tag_part, mask = (cv2.resize(cv2.warpPerspective(one, warp, shape), tuple(
        int(length) for length in high - low), interpolation=cv2.INTER_AREA) / 255.0
        for one in (smooth, np.full_like(picture, 255)))
    tag_part, mask = (cv2.GaussianBlur(one, (0, 0), blur_px) for one in (tag_part, mask))
    view = gray[low[1]:high[1], low[0]:high[0]].astype(float)
    mixed = levels[0] * mask + (levels[1] - levels[0]) * tag_part + view * (1.0 - mask) \
        + rng.normal(0.0, 2.0, view.shape) * (mask > 0.01)
    found = gray.copy()
    found[low[1]:high[1], low[0]:high[0]] = np.clip(np.round(mixed), 0, 255).astype(np.uint8)
    return found, corners


def tag_before(camera: Camera, rng: np.random.Generator, side_px: float, most_tilt_deg: float
               ) -> tuple[Array, float]:
    """Return a random pose (4, 4), camera_from_tag, for a length of the sides, and its tilt."""
    depth, tilt = camera.fx * _SIZE_M / side_px, np.radians(rng.uniform(0.0, most_tilt_deg))
    towards = rng.uniform(0.0, 2.0 * np.pi)
    margin = min(0.9 * side_px, 0.45 * camera.height)
    pixel = rng.uniform([margin] * 2, [camera.width - margin, camera.height - margin])
    bearing, = camera.normalize_points(pixel[None])
    turn = Rotation.from_rotvec(tilt * np.array([np.cos(towards), np.sin(towards), 0.0])) \
        * Rotation.from_euler('z', rng.uniform(-0.5, 0.5))
    return make_transform(turn.as_matrix() * (1.0, -1.0, -1.0), depth * np.append(
        bearing, 1.0)), float(np.degrees(tilt))


def in_map(number: int, map_from_tag: Array) -> Tag:
    """Return a tag of the map."""
    return Tag(f'{_FAMILY}_{number}', _FAMILY, number, _SIZE_M, tuple(map_from_tag[:3, 3]),
               tuple(quaternion_from_transform(map_from_tag)))


def study_images(options: argparse.Namespace) -> int:
    """Print recall, corner errors, times, false ids and accepted flips."""
    try:
        from pupil_apriltags import Detector
        other = Detector(_FAMILY, quad_decimate=1.0)
    except ImportError:
        other = None
    files = [file for folder in options.folders for file in sorted(folder.rglob('*'))
             if file.suffix in ('.jpg', '.png') and 'depth' not in file.name]
    rng, rows = np.random.default_rng(options.seed), defaultdict[str, list[Any]](list)
    counts, took_s = Counter[str](), defaultdict[str, float](float)
    for number in range(options.images):
        gray = cv2.imread(str(files[int(rng.integers(len(files)))]), cv2.IMREAD_GRAYSCALE)
        gray = cv2.resize(gray, (640, 480))
        camera = Camera(640, 480, 544.0, 544.0, 320.0, 240.0)
        rgb = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
        begin = time.process_time()
        counts['false ids'] += len(detect_tags(rgb, camera, [_FAMILY]).names)
        took_s['without a tag'] += time.process_time() - begin
        camera_from_tag, _ = tag_before(camera, rng, float(np.exp(rng.uniform(
            np.log(12.0), np.log(200.0)))), 75.0)
        tag = in_map(number % 587, _POSE @ camera_from_tag)
        image, corners = painted(gray, tag, camera_from_tag, camera, float(rng.choice(
            [0.5, 0.8, 1.2, 2.0])), (rng.uniform(10, 60), rng.uniform(120, 230)), rng)
        short = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()
        bin_of = next(f'{low} to {high} px' for low, high in (
            (0, 10), (10, 16), (16, 30), (30, 60), (60, 999)) if short < high)
        begin = time.process_time()
        seen = detect_tags(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), camera, [_FAMILY])
        took_s['with a tag'] += time.process_time() - begin
        found = [seen.corners_px[seen.names.index(tag.name)]] if tag.name in seen.names else []
        theirs = [] if other is None else [one.corners[::-1] - 0.5 for one in other.detect(image)
                                           if one.tag_id == tag.number]
        rows[bin_of].append([np.linalg.norm(one[0] - corners, axis=1).mean() if one else np.nan
                             for one in (found, theirs)])
        if not found:
            continue
        landmark_map = replace(LandmarkMap.empty('map'), tags=(tag,))
        answer = Relocalizer(landmark_map, _OPTIONS).relocalize(
            [Observation(camera, _NOTHING, tags=seen)])
        right = answer.map_from_camera is not None and SAME_ANSWER.agree(
            answer.map_from_camera, _POSE)
        counts[f'{"accepted" if answer.accepted else "refused"} {"right" if right else "flip"}'] \
            += 1
    cells = []
    for name, own in sorted(rows.items(), key=lambda row: int(row[0].partition(' ')[0])):
        cells.append([name, len(own)])
        for errors in np.array(own).T:
            known = errors[np.isfinite(errors)]
            cells[-1] += [len(known), ' '.join(f'{value:.2f}' for value in np.percentile(
                known, [50, 90])) if len(known) else '-']
    print(table(['shortest side', 'tags', 'found', 'error [px], 50, 90 %',
                 'pupil-apriltags: found', 'error [px]'], cells))
    print({**counts, **{f'ms {name}': round(1e3 * value / options.images, 1)
                        for name, value in took_s.items()}})
    return 0


def study_acceptance(options: argparse.Namespace) -> int:
    """Print accepted, wrong and right poses with tags that are right, moved, and of wrong size."""
    landmark_map = LandmarkMap.from_file(options.map)
    rng, rows = np.random.default_rng(options.seed), defaultdict[str, list[Any]](list)
    queries = make_queries(load_queries(options.queries), landmark_map, every_frame=True)
    for query in queries[::options.every]:
        boxes = replace(query.observation, similarities=None)
        bare = replace(boxes, detections=_NOTHING, depths=None)
        camera, pose = boxes.camera, query.map_from_camera
        tags = [in_map(number, pose @ tag_before(
            camera, rng, camera.fx * _SIZE_M / rng.uniform(0.7, 3.0), 60.0)[0])
            for number in range(4)]
        corners = []
        for tag in tags:
            inside = np.linalg.inv(pose) @ np.c_[tag.corners, np.ones(4)].T
            corners.append(camera.project_normalized((inside[:2] / inside[2]).T)
                           + rng.normal(0.0, 0.3, (4, 2)))
        angle, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.2, 4.0)
        move = make_transform(Rotation.from_euler('z', rng.uniform(-np.pi, np.pi)).as_matrix(),
                              np.zeros(3))

        shift, center = away * np.array([np.cos(angle), np.sin(angle), 0.0]), tags[0].center

        def moved(tag: Tag, move: Array = move, shift: Array = shift, center: Any = center) -> Tag:
            place = move @ tag.map_from_tag
            place[:3, 3] = move[:3, :3] @ np.subtract(tag.center, center) + center + shift
            return replace(tag, center=tuple(place[:3, 3]),
                           quat_xyzw=tuple(quaternion_from_transform(place)))
        wrong_size = replace(tags[0], size=_SIZE_M * float(rng.choice([0.4, 0.5, 2.0, 2.5])))
        for name, own, count in (
                ('no tag', [], 0), ('1 tag', tags[:1], 1), ('2 tags', tags[:2], 2),
                ('4 tags', tags, 4), ('moved or copied', [moved(tags[0])], 1),
                ('another size', [wrong_size], 1),
                ('board of 2 moved', [moved(tag) for tag in tags[:2]], 2),
                ('1 of 2 moved', [moved(tags[0]), tags[1]], 2)):
            for kind, seen in (('', boxes), (', no boxes', bare)):
                answer = Relocalizer(replace(landmark_map, tags=tuple(own)), _OPTIONS).relocalize(
                    [replace(seen, tags=SeenTags(tuple(tag.name for tag in tags[:count]),
                                                 np.array(corners[:count]).reshape(-1, 4, 2)))])
                found = answer.map_from_camera
                error = (np.inf, 0.0) if found is None else pose_error(found, pose)
                rows[name + kind].append((answer.accepted, *error))
    print(table(['tags', 'queries', 'accepted', 'wrong', 'error [m], 50, 95 %'], [
        [name, len(own), len(accepted), sum(not SAME_ANSWER.distance_m > metres
                                            or degrees > SAME_ANSWER.angle_deg
                                            for metres, degrees in accepted),
         ' '.join(f'{value:.3f}' for value in np.percentile(
             [metres for metres, _ in accepted] or [np.nan], [50, 95]))]
        for name, own in rows.items()
        for accepted in [[(metres, degrees) for is_accepted, metres, degrees in own
                          if is_accepted]]]))
    return 0


def main(args: Sequence[str] | None = None) -> int:
    """Run a study; return the exit code."""
    parser = argparse.ArgumentParser(prog='studies.tags', description=__doc__)
    parser.add_argument('--seed', type=int, default=0)
    kinds = parser.add_subparsers(required=True)
    for name, study in (('images', study_images), ('accept', study_acceptance)):
        kind = kinds.add_parser(name)
        kind.set_defaults(study=study)
        if study is study_images:
            kind.add_argument('folders', type=Path, nargs='+')
            kind.add_argument('--images', type=int, default=300)
        else:
            kind.add_argument('queries', type=Path)
            kind.add_argument('map', type=Path)
            kind.add_argument('--every', type=int, default=2)
    options = parser.parse_args(args)
    return run_command(lambda: options.study(options))


if __name__ == '__main__':
    sys.exit(main())
