"""Animatable 3D Gaussian avatars from rolling-shutter video."""

__version__ = "0.1.0"
