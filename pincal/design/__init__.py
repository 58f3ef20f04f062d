"""Design of measurements: which poses to measure, how many, and what they will tell before any is measured."""
