"""Identification: start values, the solver, its stages, and which parameters the data determine."""
