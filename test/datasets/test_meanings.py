# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fields that define the meaning of a value are read; contradictions to the images are reported.

Recordings are real images and poses or the demo's walk, with one field altered.
"""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rig_bag
from capture_folders import edited, shots_of, write_colmap, write_nerf
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.messages import image_from_msg
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_frames
from cliploc_ros.offline.datasets.bag_poses import PoseSource
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.tum import read_tum_trajectory

pytestmark = pytest.mark.needs('pycolmap')
METRES = FolderOptions(scale=1.0)
START, MS = 1_700_000_000 * 10**9, 10**6
ODOMETRY = 'nav_msgs/msg/Odometry'
DEPTH = np.full((48, 64), 2000, dtype=np.uint16)


@pytest.fixture(scope='module')
def shots():
    return shots_of()


@pytest.fixture(scope='module')
def room(shared_data):
    """Return 48 real images with their poses and camera, as (stamp, image, pose, camera)."""
    frames = read_folder(shared_data / 'rooms/hololens_office', FolderOptions(layout='tum'))
    return [(START + 100 * MS * place, one.image_rgb, one.map_from_camera, one.camera)
            for place, one in enumerate(frames.select(range(48)).read())]


def odometry_message(stamp, child, pose):
    field, zeros = bag_messages.pose_message(stamp, 'map', pose), np.zeros(36)
    zero = rig_bag.make('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
    return rig_bag.make(ODOMETRY, header=field.header, child_frame_id=child,
                pose=rig_bag.make('geometry_msgs/msg/PoseWithCovariance', pose=field.pose,
                          covariance=zeros),
                twist=rig_bag.make('geometry_msgs/msg/TwistWithCovariance', covariance=zeros,
                                   twist=rig_bag.make('geometry_msgs/msg/Twist', linear=zero,
                                                      angular=zero)))


def write_bag(path, room, *, frame='camera', pose=lambda pose: pose, info=lambda message: message,
              stamp=lambda stamp: stamp, more=(), poses=True):
    """Write images, camera_info and /ground_truth of a room, each changed by a function."""
    recorded = [*more]
    for at, pixels, true_pose, camera in room:
        image, (_, *given, message) = rig_bag.camera_messages(at, pixels, camera, frame, stamp(at))
        recorded += [image, (at, *given, info(message))]
        if poses:
            recorded += rig_bag.pose_messages([(at, pose(true_pose))], '/ground_truth',
                                              stamp(at) - at)
    return rig_bag.write_messages(path, recorded)


def poses_of(room):
    return [(at, pose) for at, _, pose, _ in room]


def reads(bag, topics=None, poses=None, depth=None):
    return bag_frames(bag, topics or BagTopics(), poses or PoseSource(), depth)


def refuses(expected, bag, *more):
    with pytest.raises(DatasetError, match=expected):
        list(reads(bag, *more).read())


def test_depth_of_transforms_json_is_in_the_unit_of_its_poses(shots, tmp_path):
    shots, notes = shots[:4], 'listed depth images are missing'
    folder = write_nerf(tmp_path, shots)
    (folder / 'depth').mkdir()
    for shot in shots:
        cv2.imwrite(str(folder / f'depth/{shot.path.stem}.png'),
                    np.full((48, 64), 1000, dtype=np.uint16))
    edited(folder, lambda values: [value.update(
        depth_file_path=f'depth/{shot.path.stem}.png')
        for value, shot in zip(values['frames'], shots, strict=True)])
    with pytest.raises(DatasetError, match='`scale`'):
        read_folder(folder)
    for fields, options, expected_m in (
            ({}, METRES, 1.0), ({}, FolderOptions(scale=2.7), 2.7),
            ({'depth_unit_scale_factor': 0.002}, METRES, 2.0),
            ({'integer_depth_scale': 0.0005}, METRES, 0.5)):
        edited(folder, lambda values, fields=fields: values.update(fields))
        frame = next(read_folder(folder, options).read())
        assert frame.depth.depths_m[0, 0] == pytest.approx(expected_m)
        edited(folder, lambda values: [values.pop(name, None) for name in (
            'depth_unit_scale_factor', 'integer_depth_scale')])
    (folder / f'depth/{shots[0].path.stem}.png').unlink()
    assert any(notes in note for note in read_folder(folder, METRES).notes)


@pytest.mark.parametrize(('text', 'red_first'), [
    ('rgb8; jpeg compressed bgr8', False), ('bgr8; png compressed rgb8', True), ('jpeg', False)])
def test_the_order_of_colours_of_compressed_images(text, red_first):
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[..., 0] = 200  # red
    stored = pixels if red_first else pixels[..., ::-1]  # what OpenCV takes for blue, green, red
    data = cv2.imencode('.png', np.ascontiguousarray(stored))[1].tobytes()
    message = replace(bag_messages.compressed_image_message(START, 'camera', data, 'png'),
                      format=text)
    assert image_from_msg(message)[0, 0].tolist() == [200, 0, 0]


def test_each_image_has_the_camera_info_of_its_time(room, tmp_path):
    """The lens zooms; once with stamps, once without."""
    few = room[:4]
    for by_stamp in (True, False):
        def info(message, by_stamp=by_stamp):
            if bag_messages.stamp_ns(message) >= few[2][0]:
                for matrix, places in ((message.k, (0, 4)), (message.p, (0, 5))):
                    matrix[list(places)] *= 1.5
            if not by_stamp:
                message.header.stamp.sec = message.header.stamp.nanosec = 0
            return message
        frames = reads(write_bag(tmp_path / str(by_stamp), few, info=info))
        assert frames.varies
        assert [frame.camera.fx for frame in frames.read()] == pytest.approx(
            np.multiply(room[0][3].fx, [1.0, 1.0, 1.5, 1.5]))


def test_a_few_bad_messages_are_left_out_and_counted(room, tmp_path):
    def info(message):
        if bag_messages.stamp_ns(message) in bad:
            message.k[:] = 0.0
        return message

    poses = rig_bag.pose_messages(poses_of(room), '/ground_truth')
    poses[3][3].pose.position.x = np.nan
    bad = {room[place][0] for place in (0, 1, 7)}
    bag = write_bag(tmp_path / 'bag', room, info=info, more=poses, poses=False)
    frames = reads(bag)
    notes = ' '.join(frames.notes)
    assert '3 of 48 messages of /camera_info left out' in notes
    assert '1 of 48 messages of /ground_truth left out' in notes
    assert sum(frame.map_from_camera is not None for frame in frames.read()) == 47
    bad = {message[0] for message in room[:20]}
    refuses('/camera_info: 10 messages', write_bag(tmp_path / 'many', room, info=info))


def test_rectified_images_beside_a_distortion(room, tmp_path):
    """It is detected from the images, whatever the name of the topic is."""
    camera = room[0][3]
    lens = replace(camera, fx=camera.fx / 0.95, fy=camera.fy / 0.95, cx=camera.cx + 4.0,
                   distortion_model='plumb_bob', distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))

    def info(message):
        made = bag_messages.camera_info_message(bag_messages.stamp_ns(message), 'camera', lens)
        made.p[:] = message.p
        return made
    bag = write_bag(tmp_path / 'bag', room, info=info)
    refuses('fit as rectified .*`rectified`', bag)
    assert not [note for note in reads(bag, BagTopics(rectified=True)).notes if 'fit' in note]
    raw = [(at, distorted(pixels, camera, lens), pose, camera) for at, pixels, pose, _ in room]
    bag = write_bag(tmp_path / 'raw', raw, info=info)
    assert not [note for note in reads(bag).notes if 'fit' in note]
    refuses('fit as raw .*leave `rectified`', bag, BagTopics(rectified=True))


def distorted(pixels, pinhole, lens):
    """Return the distorted image of a lens from an image of a pinhole camera."""
    grid = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
    places = cv2.undistortPoints(grid.reshape(-1, 1, 2).astype(np.float32), lens.matrix,
                                 np.array(lens.distortion), P=pinhole.matrix)
    places = places.reshape(lens.height, lens.width, 2).astype(np.float32)
    return cv2.remap(pixels, places[..., 0], places[..., 1], cv2.INTER_LINEAR)


def test_whose_poses_they_are_and_in_which_frame_depth_is(room, tmp_path):
    mount = make_transform(Rotation.from_euler('xyz', [-90, 0, -90], degrees=True).as_matrix(),
                           np.array([0.2, 0.0, 1.0]))
    odometry = [(at, '/ground_truth', ODOMETRY, odometry_message(
        at, '/base_footprint', pose @ invert_transform(mount))) for at, _, pose, _ in room]
    static = rig_bag.tf_messages([(START, mount)], 'base_footprint', topic='/tf_static')
    refuses('base_footprint.*`mount`', write_bag(tmp_path / 'a', room, more=odometry, poses=False))
    bag = write_bag(tmp_path / 'b', room, more=[*odometry, *static], poses=False)
    frame = next(reads(bag).read())
    np.testing.assert_allclose(frame.map_from_camera, room[0][2], atol=1e-6)
    # the frame of the images is the camera's body: x forward
    body = make_transform(Rotation.from_euler('xyz', [-90, 0, -90], degrees=True).as_matrix(),
                          np.zeros(3))
    refuses('fit as ros .*`mount` 0 0 0 -0.5 0.5 -0.5 0.5', write_bag(
        tmp_path / 'c', room, pose=lambda pose: pose @ invert_transform(body)))
    # depth of another camera needs its camera_info and tf
    depth_from = make_transform(np.eye(3), np.array([0.05, 0.0, 0.0]))
    depths = [(at, '/depth/image', bag_messages.IMAGE, rig_bag.depth_message(at, DEPTH, 'depth'))
              for at, *_ in room]
    topics = BagTopics(depth='/depth/image')
    refuses("frame 'depth'.*/depth/camera_info is missing", write_bag(
        tmp_path / 'd', room, more=depths), topics)
    infos = [(START, '/depth/camera_info', bag_messages.CAMERA_INFO,
              bag_messages.camera_info_message(START, 'depth', room[0][3])),
             *rig_bag.tf_messages([(START, depth_from)], 'camera', 'depth', '/tf_static')]
    frame = next(reads(write_bag(tmp_path / 'e', room, more=[*depths, *infos]), topics).read())
    np.testing.assert_allclose(frame.depth.camera.color_from_depth, depth_from, atol=1e-9)


@pytest.mark.parametrize(('header', 'row'), [
    ('', '1700000000500 1 2 3 0.1 0.2 0.3 0.927362'),
    ('#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], '
     'q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]',
     '1700000000500000000, 1, 2, 3, 0.927362, 0.1, 0.2, 0.3, 9'),
    ('index,time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw',
     '7,1700000000.5,1000,2000,3000,0.1,0.2,0.3,0.927362'),
    ('', '1700000000.5 0.74 -0.516377 0.430945 1 0.596377 0.8 -0.065472 2 -0.310945 '
         '0.305472 0.9 3')])
def test_columns_of_trajectories(header, row, tmp_path):
    path = tmp_path / 'poses.txt'
    path.write_text(f'{header}\n{row}\n')
    poses = read_tum_trajectory(path)
    assert poses.stamps_ns.tolist() == [1_700_000_000_500_000_000]
    np.testing.assert_allclose(poses.positions_xyz, [[1, 2, 3]])
    np.testing.assert_allclose(poses.quats_xyzw, [[0.1, 0.2, 0.3, 0.927362]], atol=1e-4)


def test_all_stamps_of_a_trajectory_have_one_unit(tmp_path):
    """Stamps of a clock that begins at 0 would be ambiguous between s, ms and us."""
    path, stamps = tmp_path / 'poses.txt', [0, 10**9, 10**12, 10**16]
    path.write_text(''.join(f'{stamp} 0 0 0 0 0 0 1\n' for stamp in stamps))
    assert read_tum_trajectory(path).stamps_ns.tolist() == stamps


@pytest.mark.parametrize(('row', 'expected'), [
    ('1e999999999 0 0 0 0 0 0 1', 'is outside'), ('1 0 0 0 0 1 0 0 0 0 1 0', 'KITTI'),
    ('0 0 0 0 0 0 1', 'without stamps'), ('1 2 3 0 0 0 1 0 9', 'name other columns')])
def test_columns_that_are_no_trajectory(row, expected, tmp_path):
    (tmp_path / 'poses.txt').write_text(f'{row}\n')
    with pytest.raises(DatasetError, match=expected):
        read_tum_trajectory(tmp_path / 'poses.txt')


def test_another_order_of_a_quaternion_is_seen_in_the_images(shared_data, tmp_path):
    """A file without a line of column names is refused; with that line it is read."""
    folder = shared_data / 'rooms/bonsai_room'
    for name in ('rgb.txt', 'camera.json', 'images'):
        (tmp_path / name).symlink_to(folder / name)
    lines = [line.split() for line in (folder / 'groundtruth.txt').read_text().splitlines()
             if not line.startswith('#')]
    other = '\n'.join(' '.join([*cells[:4], cells[7], *cells[4:7]]) for cells in lines)
    (tmp_path / 'groundtruth.txt').write_text(other)
    with pytest.raises(DatasetError, match=r'quaternions w x y z .*name the columns'):
        read_folder(tmp_path)
    (tmp_path / 'groundtruth.txt').write_text(f'# timestamp tx ty tz qw qx qy qz\n{other}')
    ours, theirs = (next(read_folder(folder_).read_raw(lambda *_: True)).map_from_camera
                    for folder_ in (tmp_path, folder))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_exif_orientation(shared_data, tmp_path):
    """Images turned to the camera's size are read; at equal sizes, a contradiction is named."""
    folder = shared_data / 'rooms/bonsai_room'
    for name in ('rgb.txt', 'groundtruth.txt'):
        shutil.copy(folder / name, tmp_path)
    shutil.copytree(folder / 'images', tmp_path / 'images')
    given = json.loads((folder / 'camera.json').read_text())
    for orientation, turn, expected in ((3, cv2.ROTATE_180, 'turned by EXIF .*auto-orient'),
                                        (6, cv2.ROTATE_90_COUNTERCLOCKWISE, None)):
        for path in sorted((folder / 'images').iterdir()):
            # as a phone stores it: the pixels of the sensor, and their orientation
            stored = cv2.rotate(cv2.imread(str(path)), turn)
            data = cv2.imencode('.jpg', stored, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            exif = b'Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01' + bytes(
                [0, orientation, 0, 0]) + bytes(4)
            block = b'\xff\xe1' + (len(exif) + 2).to_bytes(2, 'big') + exif
            (tmp_path / 'images' / path.name).write_bytes(data[:2] + block + data[2:])
        (tmp_path / 'camera.json').write_text(json.dumps(given))
        if expected is None:
            frame = next(read_folder(tmp_path).read())
            assert frame.image_rgb.shape[:2] == (given['height'], given['width'])
        else:
            with pytest.raises(DatasetError, match=expected):
                read_folder(tmp_path)


def test_mirrored_images_are_named(room, tmp_path):
    for axis, name in enumerate(('upside down', 'left and right')):
        refuses('the images are mirrored', write_bag(tmp_path / name, [
            (at, np.ascontiguousarray(np.flip(image, axis)), pose, camera)
            for at, image, pose, camera in room]))


@pytest.mark.parametrize(('jump_m', 'turn_deg'), [(0.25, 0.0), (0.0, 10.0), (0.1, 0.0)])
def test_only_poses_after_a_jump_of_the_localizer_are_used(room, tmp_path, jump_m, turn_deg):
    """map -> odom is corrected at the 20th image; odometry has the poses of the camera."""
    poses, turn = poses_of(room), Rotation.from_euler('z', turn_deg, degrees=True).as_matrix()
    corrected = make_transform(turn, np.array([jump_m, 0.0, 0.0]))
    tf = [*rig_bag.tf_messages([(at, corrected if place >= 20 else np.eye(4))
                                for place, (at, _) in enumerate(poses)], 'map', 'odom'),
          *rig_bag.tf_messages(poses, 'odom')]
    bag = write_bag(tmp_path / 'bag', room, more=tf, poses=False)
    frames, is_jump = reads(bag), jump_m != 0.1
    named = f' {jump_m or ""}.* m and {turn_deg} degrees at {poses[20][0] / 1e9:.2f}'
    assert any(re.search(named, note) for note in frames.notes) == is_jump
    known = [frame.map_from_camera for frame in frames.read()]
    assert [pose is None for pose in known] == [place < 20 * is_jump for place in range(48)]
    np.testing.assert_allclose(known[20], corrected @ poses[20][1], atol=1e-6)
    assert frames.of_tf
    # the frame of odometry drifts, but has no jump
    frames = reads(bag, poses=PoseSource(map_frame='odom'))
    assert re.search('odometry drifts(?!.* jumps)', '; '.join(frames.notes))


def test_messages_of_two_cameras_or_bodies_on_one_topic(room, tmp_path):
    few, camera = room[:3], room[0][3]
    for number, (topic, kind, message) in enumerate((
            ('/camera_info', bag_messages.CAMERA_INFO, lambda at: bag_messages.camera_info_message(
                at, 'right', replace(camera, fx=1.5 * camera.fx))),
            ('/image', bag_messages.IMAGE,
             lambda at: bag_messages.image_message(at, '/right', few[0][1])))):
        more = [(at, topic, kind, message(at)) for at, *_ in few]
        refuses(f'{topic} has messages of several coordinate frames, camera, right',
                write_bag(tmp_path / str(number), few, more=more))
    odometry = [(at, '/ground_truth', ODOMETRY, odometry_message(at, child, pose))
                for at, _, pose, _ in few for child in ('camera', 'gripper')]
    refuses(r'frames, camera, gripper \(child_frame_id\)',
            write_bag(tmp_path / 'odometry', few, more=odometry, poses=False))


def test_depth_of_a_camera_without_calibration_and_of_one_of_several_robots(room, tmp_path):
    few, topics = room[:3], BagTopics(depth='/depth/image', tf='/robot2/tf')
    info = bag_messages.camera_info_message(START, 'depth', room[0][3])
    more = [(at, '/depth/image', bag_messages.IMAGE, rig_bag.depth_message(at, DEPTH, 'depth'))
            for at, *_ in few]
    more += [(START, '/depth/camera_info', bag_messages.CAMERA_INFO, info)]
    for robot in ('/robot1', '/robot2'):
        more += rig_bag.tf_messages([(START, np.eye(4))], 'camera', 'depth', f'{robot}/tf_static')
        more += rig_bag.tf_messages(poses_of(few), topic=f'{robot}/tf')
    frame = next(reads(write_bag(tmp_path / 'a', few, more=more), topics).read())
    assert frame.depth.camera.fx == room[0][3].fx
    info.k[:] = np.nan
    refuses('/depth/camera_info has no calibration', write_bag(tmp_path / 'b', few, more=more),
            topics)


def test_stamps_that_begin_again(room, tmp_path):
    """All of a run, and those of a camera whose clock restarts."""
    half = room[len(room) // 2][0]
    poses = rig_bag.pose_messages(poses_of(room), '/ground_truth')
    for more, topic in (((), 'ground_truth'), (poses, 'camera_info')):
        refuses(f'/{topic}: the stamps jump back: .*ros2 bag convert', write_bag(
            tmp_path / topic, room, more=more, poses=not more,
            stamp=lambda at: at - (half - START if at >= half else 0)))


def test_two_sources_of_one_value(room, shots, tmp_path):
    folder = write_nerf(tmp_path / 'nerf', shots)
    edited(folder, lambda values: values.update(camera_angle_x=1.0))
    with pytest.raises(DatasetError, match='two focal lengths'):
        read_folder(folder, METRES)
    folder = write_colmap(tmp_path / 'c', shots)
    other = write_colmap(tmp_path / 'd', shots, text=True, camera_of=lambda _: (
        'PINHOLE', shots[0].camera.width, shots[0].camera.height, [400, 400, 320, 240]))
    for name in ('cameras.txt', 'images.txt'):
        shutil.copy(other / 'sparse/0' / name, folder / 'sparse/0')
    with pytest.raises(DatasetError, match=r'\.bin and \.txt .* different cameras'):
        read_folder(folder, METRES)
    # a topic and tf
    beside = make_transform(np.eye(3), np.array([0.18, 0.0, 0.0]))
    moving = rig_bag.tf_messages([(at, beside @ pose) for at, pose in poses_of(room)])
    notes = reads(write_bag(tmp_path / 'bag', room, more=moving)).notes
    assert any('different poses of the camera: 18 cm' in note for note in notes)


def test_paths_of_other_systems_and_folders_of_splatting(shots, tmp_path):
    folder = write_nerf(tmp_path / 'nerf', shots)

    def absolute(values):
        for one in values['frames']:
            one['file_path'] = 'C:\\Users\\me\\scan\\images\\' + one['file_path'].split('/')[-1]
    edited(folder, absolute)
    assert read_folder(folder, METRES).count == len(shots)
    shutil.move(folder / 'images', tmp_path / 'elsewhere')
    assert read_folder(folder, FolderOptions(scale=1.0, images=tmp_path / 'elsewhere')
                       ).count == len(shots)
    project = write_colmap(tmp_path / 'distorted/splats', shots)  # its parent has no effect
    (project / 'distorted').mkdir()
    shutil.move(project / 'sparse', project / 'distorted/sparse')
    shutil.move(project / 'images', project / 'input')
    assert read_folder(project, METRES).count == len(shots)
    (project / 'distorted/sparse/0/images.bin').unlink()
    with pytest.raises(DatasetError, match=r'lacks images\.bin'):
        read_folder(project, METRES)


@pytest.mark.parametrize(('there', 'expected'), [
    ('data.csv', 'write rgb.txt'), ('camera_matrix.csv', 'lacks odometry.csv'),
    ('database.db', 'mapper')])
def test_layouts_that_are_not_read_are_named(there, expected, tmp_path):
    (tmp_path / there).touch()
    with pytest.raises(DatasetError, match=expected):
        read_folder(tmp_path)


def test_tf_under_the_name_of_a_robot_and_a_way_out_of_bad_drivers(room, tmp_path):
    moving, second = (rig_bag.tf_messages(poses_of(room), topic=f'/{robot}/tf')
                      for robot in ('robot1', 'robot2'))
    bag = write_bag(tmp_path / 'bag', room, more=moving, poses=False)
    np.testing.assert_allclose(next(reads(bag).read()).map_from_camera, room[0][2], atol=1e-6)
    bag = write_bag(tmp_path / 'two', room, more=[*moving, *second], poses=False)
    refuses('several robots: /robot1/tf, /robot2/tf; give `tf`', bag, None,
            PoseSource(map_frame='map'))
    frames = reads(bag, None, PoseSource(map_frame='map', tf='/robot2/tf'))
    assert next(frames.read()).map_from_camera is not None
    # no calibration: use a file instead
    bag = write_bag(tmp_path / 'zero', room[:3], info=lambda message: replace(
        message, k=np.zeros(9), p=np.zeros(12)))
    refuses('camera_info', bag)
    (tmp_path / 'camera.json').write_text(json.dumps({
        name: getattr(room[0][3], name) for name in ('width', 'height', 'fx', 'fy', 'cx', 'cy')}))
    topics = BagTopics(intrinsics=str(tmp_path / 'camera.json'))
    assert next(reads(bag, topics).read()).camera.fx == room[0][3].fx
    # stamps that are 60 ms apart
    apart = rig_bag.pose_messages(poses_of(room[:3]), '/late', 60 * MS)
    bag = write_bag(tmp_path / 'apart', room[:3], more=apart)
    assert [next(reads(bag, None, PoseSource('/late', tolerance_ns=most * MS)).read()
                 ).map_from_camera is None for most in (20, 100)] == [True, False]


def test_names_tell_nothing_of_the_order_of_images(shots, tmp_path):
    """No alarm if images that follow each other by name do not overlap."""
    order = np.random.default_rng(0).permutation(len(shots))
    for number, shot in zip(order, shots, strict=True):
        (tmp_path / f'Küche {number}.jpg').symlink_to(shot.path)
    folder = write_nerf(tmp_path / 'scan', [
        shot._replace(path=tmp_path / f'Küche {number}.jpg')
        for number, shot in zip(order, shots, strict=True)])
    assert not [note for note in read_folder(folder, METRES).notes if 'fit' in note]
