# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build and install the package with colcon; script/setup makes the Python environment."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'cliploc_ros'


def files(folder: str, pattern: str) -> list[str]:
    """List the files of a folder to install; the folder may be absent."""
    return [str(path) for path in sorted(Path(folder).glob(pattern))]


setup(
    name=PACKAGE,
    version='0.1.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        f'{PACKAGE}.datasets': ['vision_msgs/msg/*.msg'],
        f'{PACKAGE}.demo': ['assets/*.*', 'assets/*/*.*', 'assets/*/rgb/*.jpg'],
        f'{PACKAGE}.vocabulary': ['*.yaml'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', files('config', '*.*')),
        (f'share/{PACKAGE}/launch', files('launch', '*.launch.*')),
    ],
    python_requires='>=3.12',
    # script/requirements*.txt hold the versions. OpenCV is missing here: pip's and apt's packages
    # of it have different names.
    install_requires=['setuptools', 'numba', 'numpy', 'PyYAML', 'scipy', 'tqdm'],
    extras_require={
        'models': [
            'huggingface_hub', 'open_clip_torch', 'openvino', 'pillow', 'safetensors', 'torch',
            'torchvision', 'ultralytics-opencv-headless',
        ],
        'cluster': ['distributed'],
        'datasets': ['rosbags'],
        'demo': ['matplotlib'],
        'studio': ['viser==1.1.1'],
        'test': ['hypothesis', 'pytest', 'pytest-rerunfailures', 'pytest-xdist'],
    },
    zip_safe=False,
    maintainer='the cliploc_ros authors',
    maintainer_email='cliploc-ros@example.org',
    description='Global localization from one image in a map of labelled objects (CLIP-Loc).',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'build_map = {PACKAGE}.cli.build_map:main',
            f'check_map = {PACKAGE}.cli.check_map:main',
            f'demo = {PACKAGE}.cli.demo:main',
            f'detector = {PACKAGE}.nodes.detector:main',
            f'evaluate = {PACKAGE}.cli.evaluate:main',
            f'import_map = {PACKAGE}.cli.import_map:main',
            f'prepare = {PACKAGE}.cli.prepare:main',
            f'relocalizer = {PACKAGE}.nodes.relocalizer:main',
            f'replay = {PACKAGE}.cli.replay:main',
            f'studio = {PACKAGE}.cli.studio:main',
            f'tum_to_bag = {PACKAGE}.cli.tum_to_bag:main',
            f'wake_up = {PACKAGE}.cli.wake_up:main',
        ],
    },
)
