"""Acceptance of a calibrated robot as a measuring instrument, by calibrated lengths and spheres."""
