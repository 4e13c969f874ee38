"""Shutters: an image is a schedule of rows."""
