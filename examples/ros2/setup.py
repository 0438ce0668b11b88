from setuptools import setup

setup(
    name="gnio_odometry",
    version="0.1.0",
    packages=["gnio_odometry"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/gnio_odometry"]),
        ("share/gnio_odometry", ["package.xml"]),
        ("share/gnio_odometry/launch", ["launch/gnio.launch.py"]),
    ],
    install_requires=["setuptools", "gnio-jax"],
    entry_points={"console_scripts": ["gnio_odometry = gnio_odometry.node:main"]},
)
