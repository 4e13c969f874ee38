"""Datasets: every loader returns a ``Subject``."""
