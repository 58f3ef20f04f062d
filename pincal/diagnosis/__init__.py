"""What has changed on a calibrated robot, from a few new poses; and new rows added to a
calibration.
"""
