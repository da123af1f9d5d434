"""The four core families of kernels in Taichi: for the GPUs of AMD, Intel and Apple, and for all cores of a CPU."""

import os

# Before anything in here imports Taichi, which would greet.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
