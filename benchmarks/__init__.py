"""Measured figures beside published ones; run with python -m benchmarks.NAME."""

import os

# One thread each, set before numpy is loaded, so that times are those of the method.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
