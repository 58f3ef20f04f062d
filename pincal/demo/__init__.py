"""The complete example on a KUKA KR 125/2, from calibration to a collision."""
