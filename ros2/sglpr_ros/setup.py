"""Build of the package by ament_python."""

from setuptools import setup

setup(
    name="sglpr_ros",
    version="0.3.0",
    description="ROS 2 node of sglpr-jax: loop closures from LiDAR scans while the robot drives.",
    license="Apache-2.0",
    packages=["sglpr_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/sglpr_ros"]),
        ("share/sglpr_ros", ["package.xml"]),
        ("share/sglpr_ros/launch", ["launch/sglpr.launch.py"]),
        ("share/sglpr_ros/config", ["config/sglpr.yaml"]),
    ],
    install_requires=["setuptools"],  # sglpr-jax is on no index: README.md installs it
    entry_points={"console_scripts": ["sglpr = sglpr_ros.node:main"]},
    zip_safe=True,
)
