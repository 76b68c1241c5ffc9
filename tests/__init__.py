"""The tests. Small matrices are slower on many threads, and much slower on a busy machine."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
