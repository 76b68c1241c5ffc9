"""Measured figures beside published ones; run with python -m benchmarks.NAME."""
