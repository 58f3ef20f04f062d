"""Calibrate a serial robot into a measuring instrument."""
