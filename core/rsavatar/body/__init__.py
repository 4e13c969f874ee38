"""Parametric bodies in SMPL's file format, and linear blend skinning."""
