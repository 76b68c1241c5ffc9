"""What colcon runs. All metadata but two fields is in pyproject.toml."""

from setuptools import setup

setup(license="Apache-2.0", python_requires=">=3.11")
