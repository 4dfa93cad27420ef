# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build and install the package, with colcon or with pip; script/setup uses colcon."""

import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'cliploc_ros'
# colcon installs these in lib/cliploc_ros for ros2 run. pip installs executables in bin/, which
# all programs share; there they are named cliploc_evaluate and so on.
COMMANDS = ('build_map', 'check_map', 'evaluate', 'export_network', 'import_map', 'studio',
            'tum_to_bag')
# These need ROS. Without ROS they would only print an error, so a wheel does not contain them.
ROS_COMMANDS = ('doctor', 'replay', 'wake_up')
NODES = ('detector', 'relocalizer')
BUILDS_WHEEL = not {'bdist_wheel', 'dist_info', 'editable_wheel'}.isdisjoint(sys.argv)

# script/requirements*.txt have the same versions. OpenCV is required by extras only, because its
# packages in pip and apt have different names.
REQUIRED = ['PyYAML>=6,<7', 'numba>=0.59,<1', 'numpy>=1.26,<3', 'scipy>=1.11,<2', 'setuptools',
            'tqdm>=4.66,<5']
OPENCV = 'opencv-python-headless>=4.6,<6'
RUNTIME = [OPENCV, 'ftfy>=6,<7', 'huggingface_hub>=0.30,<4', 'openvino>=2025.0,<2028',
           'pillow>=10,<15', 'tokenizers>=0.20,<1']
EXTRAS = {
    # Detector and CLIP as ONNX networks.
    'runtime': RUNTIME,
    # With PyTorch: to export networks, and to train.
    'models': [
        *RUNTIME, 'onnx>=1.17,<2', 'open_clip_torch>=3.0,<4', 'safetensors>=0.4,<1',
        'torch>=2.4,<3', 'torchvision>=0.19,<1', 'ultralytics-opencv-headless>=8.4,<9',
    ],
    # The programs that make, check and evaluate maps.
    'evaluate': [OPENCV, 'matplotlib>=3.8,<4', 'rosbags>=0.11,<0.12'],
    'studio': [OPENCV, 'rosbags>=0.11,<0.12', 'viser==1.1.1'],
    'cluster': ['distributed>=2024.8,<2028'],
}
EXTRAS['all'] = sorted({name for extra in EXTRAS.values() for name in extra})
EXTRAS['test'] = ['hypothesis>=6.100,<7', 'onnx>=1.17,<2', 'pytest>=7.4,<10',
                  'pytest-rerunfailures>=14,<17', 'pytest-xdist>=3.5,<4']
EXTRAS['docs'] = ['myst-parser>=4,<6', 'sphinx>=8,<10', 'sphinx-rtd-theme>=3,<4']
MANIFEST = ElementTree.parse(Path(__file__).with_name('package.xml')).getroot()
URLS = {url.get('type'): url.text for url in MANIFEST.iter('url')}


def files(folder: str, pattern: str) -> list[str]:
    """List the files of a folder to install; the folder may be absent."""
    return [str(path) for path in sorted(Path(folder).glob(pattern))]


def console_scripts() -> list[str]:
    """Return the entry points, with the names that suit their folder."""
    if BUILDS_WHEEL:
        return [f'cliploc_{name} = {PACKAGE}.cli.{name}:main' for name in COMMANDS]
    modules = [f'cli.{name}' for name in COMMANDS + ROS_COMMANDS]
    modules += [f'nodes.{name}' for name in NODES]
    return [f'{module.partition(".")[2]} = {PACKAGE}.{module}:main' for module in modules]


setup(
    name=PACKAGE,
    version=MANIFEST.findtext('version'),
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        f'{PACKAGE}.offline.datasets': ['vision_msgs/msg/*.msg'],
        f'{PACKAGE}.core': ['calibration.yaml'],
        f'{PACKAGE}.offline': ['page.css'],
        f'{PACKAGE}.offline.studio': ['web/*'],
        f'{PACKAGE}.offline.vocabulary': ['*.yaml'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', files('config', '*.*')),
        (f'share/{PACKAGE}/launch', files('launch', '*.launch.*')),
    ],
    python_requires='>=3.12',
    install_requires=REQUIRED,
    extras_require=EXTRAS,
    zip_safe=False,
    maintainer='the cliploc_ros authors',
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    description='Global localization from one image in a map of labelled objects (CLIP-Loc).',
    long_description=(Path(__file__).parent / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    url=URLS['website'],
    project_urls={'Changelog': f'{URLS["repository"]}/blob/main/CHANGELOG.rst',
                  'Issues': URLS['bugtracker']},
    license='Apache-2.0',
    entry_points={'console_scripts': console_scripts()},
)
