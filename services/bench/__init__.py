"""Measurements of the service: real processes, real HTTP, the targets that it promises to keep."""
