"""Metric rows to tables: JSON, CSV, Markdown, LaTeX. Standard library only; equal rows give equal bytes."""
