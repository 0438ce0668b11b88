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
    zip_safe=True,
    maintainer="gnio-jax",
    maintainer_email="gnio-jax@users.noreply.github.com",
    description="Inertial odometry of a pedestrian by gnio-jax",
    license="Apache-2.0",
    entry_points={"console_scripts": ["gnio_odometry = gnio_odometry.node:main"]},
)
