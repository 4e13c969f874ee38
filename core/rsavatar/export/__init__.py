"""A finished job, opened again: views of it, and files for other programs."""
