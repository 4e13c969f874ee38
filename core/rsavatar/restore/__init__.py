"""Restoring images in 2D: warps, flows, frame interpolation, rolling-shutter correction."""
