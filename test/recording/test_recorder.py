# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observations of the demo's walk with its real networks: complete, resumed, by two workers."""

import fcntl
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from io import StringIO

import cv2
import numpy as np
import onnx
import pytest
from capture_folders import ASSETS, copy_walk
from scipy.spatial.transform import Rotation

from cliploc_ros.cli import check_map
from cliploc_ros.cli.build_map import main
from cliploc_ros.cli.tum_to_bag import main as tum_to_bag
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.map.landmark_embeddings import load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions, Frames, RawFrame
from cliploc_ros.offline.datasets.map_recording import load_recording
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.recording import recorder

NETWORKS = ('--model', ASSETS / 'yolo.onnx')
CLIP = ('--clip-pretrained', ASSETS / 'clip')
COLOURS = ('red', 'orange', 'yellow', 'green', 'blue', 'purple', 'pink', 'brown', 'black', 'white')
# A short walk shows objects from one side only: this test is about the networks' output.
ALL = ('--min-baseline', '1', '--frame-id', 'room', '--no-check', '--no-keyframe-layer')
TIMEOUT_S = 600.0  # with networks, on a machine under load


def arguments(*parts):
    return [*map(str, parts)]


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return a third of the demo's walk with flat depth, and poses for all but the last image."""
    folder = tmp_path_factory.mktemp('walk') / 'tum'
    rows = copy_walk(ASSETS / 'sequence', folder, 3, with_last=False)
    (folder / 'depth').mkdir()
    cv2.imwrite(str(folder / 'depth/flat.png'), np.full((480, 640), 10000, dtype=np.uint16))
    (folder / 'depth.txt').write_text(''.join(f'{row.split()[0]} depth/flat.png\n'
                                              for row in rows))
    return folder


@pytest.fixture(scope='module')
def recorded(walk):
    """Return the observations of an uninterrupted run of the executable."""
    with redirect_stdout(StringIO()) as output:
        assert main(arguments('--tum', walk, *NETWORKS, *CLIP, *ALL, '--out',
                              walk.parent / 'map.yaml')) == 0
    assert 'no pose: 1 of 16' in output.getvalue()
    assert {path.name.partition('.')[0] for path in walk.parent.iterdir()} == {'tum', 'map'}
    recording = load_recording(walk.parent / 'map.yaml')
    return recording.observations


def test_observations_lie_in_the_cache_under_their_content(walk, recorded, tmp_path, capsys):
    content = load_observations(recorded)
    assert (content.images, content.without_pose, len(content)) == (16, 1, 15)
    embeddings = content.embeddings
    assert embeddings.shape == (len(content.scores), 128)
    np.testing.assert_allclose(np.linalg.norm(embeddings.astype(float), axis=1), 1.0, atol=1e-3)
    assert content.encoder_key
    before, copy = recorded.stat().st_mtime_ns, tmp_path / 'tum'
    shutil.copytree(walk, copy, copy_function=shutil.copyfile)
    frames = read_folder(copy, FolderOptions(layout='tum'))
    image = min((copy / 'rgb').iterdir())
    pixels = image.read_bytes()
    image.write_bytes(pixels[:-1] + b'x')
    assert read_folder(copy, FolderOptions(layout='tum')).digest != frames.digest
    image.write_bytes(pixels)
    assert main(arguments('--tum', copy, *NETWORKS, *CLIP, *ALL, '--seed', 3, '--out',
                          walk.parent / 'second.yaml')) == 0
    assert recorded.stat().st_mtime_ns == before
    assert main(arguments('--observations', recorded, *ALL, '--seed', 3, '--out',
                          walk.parent / 'third.yaml')) == 0
    second, third = ((walk.parent / name).read_text().replace('tum', recorded.name).splitlines()
                     for name in ('second.yaml', 'third.yaml'))
    assert [line for line in second if 'center' in line] == [
        line for line in third if 'center' in line]


def first_colour(label):
    return next((word for word in label.split() if word in COLOURS), None)


def test_labels_and_embeddings_lie_next_to_the_map(walk, recorded):
    path, true = walk.parent / 'map.yaml', LandmarkMap.from_file(ASSETS / 'map.yaml')
    built = LandmarkMap.from_file(path)
    distances = np.linalg.norm(built.centers[:, None] - true.centers, axis=2)
    pairs = [(first_colour(built.labels[row]), first_colour(true.labels[distances[row].argmin()]))
             for row in range(len(built)) if distances[row].min() < 0.15]
    assert len(pairs) >= 6 and np.mean([found == meant for found, meant in pairs]) >= 0.6
    for label, details in zip(built.labels, built.details, strict=True):
        assert details.labels[0][0] == label and len(details.labels) == 6
    embeddings = load_embeddings_of_map(path, built.landmark_ids)
    assert embeddings.encoder_key == load_observations(recorded).encoder_key
    assert embeddings.is_known.all() and embeddings.means.shape == (len(built), 128)


def test_phrases_of_a_user(recorded, tmp_path, capsys):
    """A pattern that the shipped vocabulary lacks."""
    words = tmp_path / 'words.yaml'
    classes = sorted(load_observations(recorded).class_names)
    words.write_text(''.join(
        f"{name}:\n  phrases: ['a {{colour}} {name} {{pattern}}', 'a {{colour}} {name}']\n"
        f"  colour: [{', '.join(COLOURS)}]\n  pattern: ['with {{second}} bands']\n"
        for name in classes))
    assert main(arguments('--observations', recorded, *CLIP, '--vocabulary', words, *ALL, '--out',
                          tmp_path / 'm.yaml')) == 0
    assert 'note:' not in capsys.readouterr().out
    assert any('bands' in text for details in LandmarkMap.from_file(tmp_path / 'm.yaml').details
               for text, _ in details.labels)


def takes_other_input(folder, order, scale):
    """Return a copy of the demo's detector that takes channels in another order and scale."""
    network = onnx.load(ASSETS / 'yolo.onnx')
    graph, name = network.graph, network.graph.input[0].name
    for node in graph.node:
        node.input[:] = ['rgb' if given == name else given for given in node.input]
    for value, key in ((np.float32(1 / scale), 'scale'), (np.array(order), 'order')):
        graph.initializer.append(onnx.numpy_helper.from_array(np.asarray(value), key))
    graph.node.insert(0, onnx.helper.make_node('Gather', ['scaled', 'order'], ['rgb'], axis=1))
    graph.node.insert(0, onnx.helper.make_node('Mul', [name, 'scale'], ['scaled']))
    onnx.save(network, folder / 'other.onnx')
    return folder / 'other.onnx'


@pytest.mark.parametrize(('order', 'scale', 'options', 'said'), [
    ([0, 1, 2], 1, (), ''),
    ([0, 1, 2], 255, (), 'with an input of RGB from 0 to 255: export it for RGB from 0 to 1'),
    ([2, 1, 0], 1, (), 'finds more with an input of BGR from 0 to 1'),
    ([2, 1, 0], 255, (), 'finds more with an input of BGR from 0 to 255'),
    ([0, 1, 2], 1, ('--conf', '0.999'), 'does the place have objects of its classes, '),
    ([0, 1, 2], 1, 'grey', 'boxes per image: the images are grey')])
def test_an_input_that_does_not_suit_the_detector_is_named(tmp_path, caplog, order, scale, options,
                                                           said):
    copy_walk(ASSETS / 'mapping', tmp_path / 'walk', 10)
    for file in (tmp_path / 'walk/rgb').iterdir() if options == 'grey' else ():
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
    model = takes_other_input(tmp_path, order, scale)
    main(arguments('--tum', tmp_path / 'walk', '--model', model, '--no-clip', *ALL, '--out',
                   tmp_path / 'map.yaml', *options * (options != 'grey')))
    assert ('note: the detector finds' in caplog.text) == bool(said)
    assert said in caplog.text


@pytest.mark.parametrize(('seen', 'error', 'kept'), [
    (0, KeyboardInterrupt, 0), (2, KeyboardInterrupt, 1), (2, DatasetError, 0)])
def test_a_run_that_fails_leaves_no_more_than_it_says(tmp_path, caplog, seen, error, kept):
    """The next run resumes from the images that are done, unless the source is unusable."""
    image = cv2.imread(str(min((ASSETS / 'sequence/rgb').iterdir())))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)

    def read(wanted):
        for place in range(seen):
            yield RawFrame(place, place, np.eye(4), lambda: (image, camera), None)
        raise error('ends here')
    frames = Frames(tmp_path / 'walk', 3, read)
    options = recorder.RecordingOptions(DetectorOptions(str(ASSETS / 'yolo.onnx')), None)
    with pytest.raises(error, match='ends here'):
        recorder.record_once(frames, options, tmp_path / 'seen.npz')
    left = list(tmp_path.iterdir())
    assert len(left) == kept
    for path in left:  # while another run has it open
        with path.open('ab') as other, pytest.raises(error, match='ends here'):
            fcntl.flock(other, fcntl.LOCK_EX)
            recorder.record_once(frames, options, tmp_path / 'seen.npz')
        assert len(list(tmp_path.iterdir())) == 1
    assert all(str(path) in caplog.text for path in left)


@pytest.mark.full
def test_killed_and_resumed(walk, recorded, tmp_path, capsys):
    file = tmp_path / 'resumed.npz'
    command = arguments('--tum', walk, *NETWORKS, *CLIP, *ALL, '--record-to', file, '--out',
                        tmp_path / 'map.yaml')
    process = subprocess.Popen([sys.executable, '-m', 'cliploc_ros.cli.build_map', *command],
                               cwd=ASSETS.parents[1], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + TIMEOUT_S
    while not any(path.stat().st_size > 15_000 for path in tmp_path.glob('.*.outputs')):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not file.exists()
    outputs, = tmp_path.glob('.*.outputs')
    with outputs.open('ab') as damaged:
        damaged.write(b'{"run": 1}\n"other"\n[]\n\x00\x10')
    assert main(command) == 0
    resumed, whole = load_observations(file), load_observations(recorded)
    for name in ('bboxes_xyxy', 'classes', 'map_from_camera', 'stamps_ns', 'embeddings'):
        np.testing.assert_allclose(getattr(resumed, name), getattr(whole, name), atol=1e-2)


def test_other_poses_use_the_boxes_again_and_depth_is_stored(walk, recorded, tmp_path, caplog):
    file = tmp_path / 'depth.npz'
    command = ('--rgbd', walk, *NETWORKS, '--no-clip', *ALL, '--record-to', file, '--out',
               tmp_path / 'map.yaml')
    for unit_m in (1.0, 1e-7):  # implausible
        assert main(arguments(*command, '--depth-unit', unit_m)) == 1
        assert not [*tmp_path.glob('.*')]
    wide = (*command, '--keyframes', '1', '180')
    assert main(arguments(*wide)) in (0, 1)  # few keyframes may give no map
    outputs, = tmp_path.glob('.*.outputs')
    count = len(load_observations(file))
    rows, moved = np.loadtxt(walk / 'groundtruth.txt'), tmp_path / 'moved.txt'
    rows[:, 1] += 1.0
    np.savetxt(moved, rows, fmt='%.9f')
    assert main(arguments(*wide, '--trajectory', moved)) in (0, 1)
    assert f'boxes of {count} images of earlier runs: {outputs}' in caplog.text
    content = load_observations(file)
    assert 2 <= len(content) < 15
    assert content.embeddings is None
    np.testing.assert_allclose(
        content.map_from_camera[0, :3, 3],
        load_observations(recorded).map_from_camera[0, :3, 3] + [1.0, 0.0, 0.0], atol=1e-6)
    # 10,000 counts of TUM are 2 m, without variation
    np.testing.assert_allclose(content.depths, 2.0, atol=1e-6)
    np.testing.assert_allclose(content.depth_spreads, 0.0, atol=1e-6)


def test_a_bag_says_the_same_and_its_topics_are_found(walk, recorded, tmp_path, capsys):
    bag, file = tmp_path / 'bag', tmp_path / 'bag.npz'
    assert tum_to_bag(arguments(walk, bag)) == 0
    command = ('--bag', bag, *NETWORKS, '--no-clip', *ALL, '--record-to', file, '--out',
               tmp_path / 'map.yaml')
    assert main(arguments(*command)) == 0
    assert '/camera_info' in capsys.readouterr().out
    from_bag, from_folder = load_observations(file), load_observations(recorded)
    np.testing.assert_allclose(from_bag.bboxes_xyxy, from_folder.bboxes_xyxy, atol=1e-2)
    np.testing.assert_allclose(from_bag.map_from_camera, from_folder.map_from_camera, atol=1e-6)
    assert from_bag.odom_from_camera is None
    # odometry is added to the earlier output of the networks
    linked = (*command, '--pose-topic', '/ground_truth', '--odometry-topic')
    assert main(arguments(*linked, '/wheels')) == 1
    assert 'no topic /wheels' in capsys.readouterr().err
    assert main(arguments(*linked, '/ground_truth')) == 0
    again = load_observations(file)
    assert (again.odom_from_camera == again.map_from_camera).all()
    assert (again.bboxes_xyxy == from_bag.bboxes_xyxy).all()
    assert check_map.main(arguments(
        tmp_path / 'map.yaml', '--observations', file, '--images', bag, '--positions', 1,
        '--headings', 1, '--frames', 1, '--out', tmp_path / 'check')) in (0, 1)
    assert f'{bag}: /image and /camera_info' in capsys.readouterr().out
    assert main(arguments('--tum', walk, '--pose-topic', '/pose', *NETWORKS, '--no-clip', '--out',
                          tmp_path / 'other.yaml')) == 1
    assert 'are for --bag' in capsys.readouterr().err


def pose(x=0.0, turn_deg=0.0):
    return make_transform(Rotation.from_euler('z', turn_deg, degrees=True).as_matrix(),
                          np.array([x, 0.0, 0.0]))


def test_keyframes_by_distance_angle_and_pose():
    is_keyframe = recorder.KeyframeFilter(recorder.KeyframeOptions(0.1, 5.0))
    walk = [None, pose(), pose(0.06), pose(0.11), None, pose(0.11, 4.0), pose(0.11, 6.0),
            pose(0.205, 6.0), pose(0.215, 6.0)]
    assert [is_keyframe(place, place, one) for place, one in enumerate(walk)] == [
        False, True, False, True, False, False, True, False, True]
    assert (is_keyframe.asked, is_keyframe.without_pose) == (9, 2)
