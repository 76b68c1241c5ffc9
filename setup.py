"""What colcon runs. The metadata is in pyproject.toml, but for two fields colcon cannot take there."""

from setuptools import setup

setup(license="Apache-2.0", python_requires=">=3.11")
