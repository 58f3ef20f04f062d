"""The extended model: coordinates, effects, poses, moments and exact Jacobians."""
