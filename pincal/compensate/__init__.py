"""Compensation: the joint positions that bring the target where it is wanted, by the calibrated model."""
