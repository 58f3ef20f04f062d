"""Measurements: tables, their plausibility, and the sensors that read them."""
