"""What has changed on a calibrated robot, told from a few new poses; and new rows taken into a calibration."""
