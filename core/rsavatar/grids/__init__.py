"""Grids: one base request varied along axes, as a list of validated jobs. Torch-free."""
