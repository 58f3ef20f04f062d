"""What a calibration is worth and where it goes: validation, result files, calibrated URDF."""
