"""Validation: accuracy at poses and on paths, replicates and ISO 9283, lack of fit, and whether a
table is of this robot.
"""
