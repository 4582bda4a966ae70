"""Build of the ROS 2 package."""

from pathlib import Path

from setuptools import setup

NAME = "ertis_ros"
SHARE = f"share/{NAME}"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", sorted(map(str, Path("launch").glob("*")))),
    ],
    install_requires=["setuptools", "ertis-numba[ros]"],
    zip_safe=True,
    maintainer="The authors of ertis-numba",
    maintainer_email="ertis-numba@users.noreply.github.com",
    description="Images, points, laser scans and odometry of imaging sonar sensors, by ertis-numba.",
    license="BSD-3-Clause",
    entry_points={"console_scripts": ["sonar = ertis_ros.sonar:main"]},
)
