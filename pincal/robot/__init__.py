"""The arm, read from a URDF, with its Denavit-Hartenberg frames and masses."""
