"""Compensation: the joint positions at which the target reaches wanted poses, by the calibrated
model.
"""
