"""Animatable 3D Gaussian avatars from rolling-shutter video."""

import os

# Read by OpenMP when torch is loaded, so it must be set before: threads that spin while they wait slow a loaded
# machine tenfold (measured: 4.9 ms became 55 ms a step beside one busy neighbour).
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
