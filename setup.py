"""The packages of the wheel. Everything else is in ``pyproject.toml``."""

from setuptools import find_packages, setup

core = find_packages(include=["mitsuba_ext", "mitsuba_ext.*"])
plugins = find_packages(
    include=["integrators", "emitters", "bsdfs", "samplers", "sensors", "shapes"]
)

setup(packages=core + [f"mitsuba_ext.{package}" for package in plugins])
