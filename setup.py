# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build and install the package, with colcon or with pip; script/setup uses colcon."""

import sys
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'cliploc_ros'
# colcon puts these into lib/cliploc_ros for ros2 run. pip puts executables into bin/, where all
# programs share one name space: there they are named cliploc_evaluate and so on.
COMMANDS = ('build_map', 'check_map', 'evaluate', 'import_map', 'studio', 'tum_to_bag')
# These need ROS. Without it they would only print that, so a wheel has none of them.
ROS_COMMANDS = ('demo', 'prepare', 'replay', 'wake_up')
NODES = ('detector', 'relocalizer')
BUILDS_WHEEL = not {'bdist_wheel', 'dist_info', 'editable_wheel'}.isdisjoint(sys.argv)

# OpenCV is no requirement of its own: pip's and apt's packages of it have different names.
OPENCV = 'opencv-python-headless'
EXTRAS = {
    'evaluate': [OPENCV, 'matplotlib', 'rosbags'],
    'build_map': [OPENCV, 'matplotlib', 'rosbags'],
    'studio': [OPENCV, 'rosbags', 'viser==1.1.1'],
    # Detector and CLIP: what looks at images. The others read observation files without it.
    'models': [
        OPENCV, 'huggingface_hub', 'open_clip_torch', 'openvino', 'pillow', 'safetensors', 'torch',
        'torchvision', 'ultralytics-opencv-headless',
    ],
    'cluster': ['distributed'],
}
EXTRAS['all'] = sorted({name for extra in EXTRAS.values() for name in extra})
EXTRAS['test'] = ['hypothesis', 'pytest', 'pytest-rerunfailures', 'pytest-xdist']


def files(folder: str, pattern: str) -> list[str]:
    """List the files of a folder to install; the folder may be absent."""
    return [str(path) for path in sorted(Path(folder).glob(pattern))]


def console_scripts() -> list[str]:
    """Return the executables under the names that their folder asks for."""
    if BUILDS_WHEEL:
        return [f'cliploc_{name} = {PACKAGE}.cli.{name}:main' for name in COMMANDS]
    modules = [f'cli.{name}' for name in COMMANDS + ROS_COMMANDS]
    modules += [f'nodes.{name}' for name in NODES]
    return [f'{module.partition(".")[2]} = {PACKAGE}.{module}:main' for module in modules]


setup(
    name=PACKAGE,
    version='0.2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        f'{PACKAGE}.datasets': ['vision_msgs/msg/*.msg'],
        # By name: evaluate and build_map put files of their own beside a recording.
        f'{PACKAGE}.demo': [
            'assets/clip.*', 'assets/map.yaml', 'assets/yolo.pt', 'assets/*/*.*',
            'assets/*/rgb/*.jpg', 'assets/rig/*/*.*', 'assets/rig/*/rgb/*.jpg',
        ],
        f'{PACKAGE}.core.acceptance': ['calibration.yaml'],
        f'{PACKAGE}.studio': ['web/studio.*'],
        f'{PACKAGE}.vocabulary': ['*.yaml'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', files('config', '*.*')),
        (f'share/{PACKAGE}/launch', files('launch', '*.launch.*')),
    ],
    python_requires='>=3.12',
    # script/requirements*.txt hold the versions.
    install_requires=['setuptools', 'numba', 'numpy', 'PyYAML', 'scipy', 'tqdm'],
    extras_require=EXTRAS,
    zip_safe=False,
    maintainer='the cliploc_ros authors',
    maintainer_email='cliploc-ros@example.org',
    description='Global localization from one image in a map of labelled objects (CLIP-Loc).',
    license='Apache-2.0',
    entry_points={'console_scripts': console_scripts()},
)
