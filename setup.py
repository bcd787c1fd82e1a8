# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Installs piezo_ident, for pip and for colcon alike."""

from glob import glob

from setuptools import find_packages, setup

package_name = 'piezo_ident'

# many records over several machines
cluster = [
    'dask>=2024.5',
    'distributed>=2024.5',
]

# transfer functions of python-control
control = [
    'control>=0.9.4,<0.11',
]

# the documentation site
docs = [
    'myst-parser>=3,<6',
    'pydata-sphinx-theme>=0.15,<1',
    'sphinx>=7.4,<10',
    'sphinx-copybutton>=0.5,<1',
    'sphinx-design>=0.6,<1',
]

# to compile, check and run what is exported as FMU; it needs a later NumPy than Jazzy has, so it
# is none of the libraries of the tests
fmu = [
    'FMPy>=0.3.32,<0.4',
]

# formats of files whose readers no ROS key brings
files = [
    'npTDMS>=1.7,<2',
    'pyarrow>=14',
]

lint = [
    'mypy>=2.4,<3',
    'ruff>=0.17,<0.18',
    'types-PyYAML>=6,<7',
]

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(include=[package_name, f'{package_name}.*']),
    package_data={
        package_name: [
            *('py.typed', 'export/templates/*.*', 'report/templates/*.html', 'schemas/*.json'),
            *('effects/c/*.c', 'operators/c/*.c'),
        ]
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
        (f'share/{package_name}/config', sorted(glob('config/*.*'))),
        (f'share/{package_name}/config/security', sorted(glob('config/security/*.xml'))),
        (f'share/{package_name}/launch', sorted(glob('launch/*.py'))),
        # for ros2 run; in a PATH they would clash with other programs
        (f'lib/{package_name}', sorted(glob('launch/nodes/*'))),
        (f'share/{package_name}/examples', sorted(glob('examples/*.*'))),
    ],
    python_requires='>=3.10',
    install_requires=[
        'PyYAML>=6,<7',
        'click>=8.1,<9',
        'h5py>=3.10,<4',
        'jinja2>=3.1,<4',
        'matplotlib>=3.6,<4',
        # for bags of a killed recorder; package.xml cannot name it, and it need not be there
        'mcap>=1.2.1,<2',
        # 0.58.1 is the first that takes NumPy 1.26
        'numba>=0.58.1,<1',
        'numpy>=1.26,<3',
        # 0.11 reads a lone .mcap or .db3 and keeps QoS profiles in the channels
        'rosbags>=0.11,<0.12',
        'scipy>=1.11,<2',
        'tqdm>=4.60,<5',
        # for compressed files of bags; comes with mcap, and need not be there either
        'zstandard>=0.15,<1',
    ],
    extras_require={
        # Real ROS 2 Jazzy for a machine without ROS.  Never on top of a ROS installation.
        'ros': [
            'ros-jazzy-common-interfaces>=5.3,<6',
            'ros-jazzy-rclpy[fastrtps]>=7.1,<8',
        ],
        'cluster': cluster,
        'control': control,
        'docs': docs,
        'files': files,
        'fmu': fmu,
        'test': [
            *cluster,
            *control,
            *docs,
            *files,
            *lint,
            'hypothesis>=6,<7',
            'jsonschema>=4,<5',
            'mcap-ros2-support>=0.5,<1',
            'nbformat>=5,<6',
            'pytest>=7.4,<10',
            'pytest-timeout>=2.2,<3',
            # 3.7 starts files in the order in which they are collected
            'pytest-xdist>=3.7,<4',
        ],
        # what the benchmarks set beside the package; all live with one numpy, 2.0 to 2.3
        'bench': [
            *cluster,
            *control,
            'pyswarms>=1.3,<2',
            'pysindy>=2.1,<3',
            'sippy_unipi>=1.0.1,<2',
            'sysidentpy>=0.9,<0.10',
        ],
        'colcon': [
            'colcon-common-extensions>=0.3,<0.4',
            'colcon-ros>=0.5,<0.6',
        ],
    },
    zip_safe=False,
    maintainer='piezo_ident maintainers',
    maintainer_email='maintainers@piezo-ident.invalid',
    description='Identifies piezo nanopositioning stages: delay, dynamics, hysteresis and more',
    license='Apache-2.0',
    entry_points={
        'console_scripts': ['piezo_ident = piezo_ident.cli:main'],
    },
)
