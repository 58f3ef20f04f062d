"""A calibration from table to result, and the calibrated model that comes of it."""
