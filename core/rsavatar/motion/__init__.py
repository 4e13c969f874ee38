"""Pose as a function of time: one trajectory per frame, learnable."""
