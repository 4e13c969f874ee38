"""Benchmarks: each module of the same name as its word, ``rsavatar bench WORD``."""
