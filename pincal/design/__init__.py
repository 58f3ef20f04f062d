"""Design of measurements: which poses to measure, how many, and the accuracy predicted before any
is measured.
"""
