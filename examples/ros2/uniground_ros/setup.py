from setuptools import setup

name = "uniground_ros"

setup(
    name=name,
    version="0.1.0",
    description="Asks a uniground server where things are, and publishes boxes, markers and a goal to drive to",
    license="MIT OR Apache-2.0",
    packages=[name],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/launch", ["launch/grounding.launch.py"]),
    ],
    # And `uniground`, from clients/python: it is not in the ROS index.
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": ["grounding = uniground_ros.node:main"]},
)
