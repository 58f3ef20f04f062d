"""Identification: start values, one solver, stages, and what the data can tell."""
