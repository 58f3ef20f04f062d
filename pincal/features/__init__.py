"""What a calibrated robot measures of a part: features with their uncertainty, and decisions on
tolerances.
"""
