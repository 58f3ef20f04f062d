"""Errors and warnings that pincal raises, each for a reader who has to act on it.

A message says what is wrong, where (file, row, column, joint), what was found, what was expected and what to do next.
The exit code of the command follows from the class: 3 for bad input, 4 for a fit that needs a decision, 5 for a gate.
"""


class PincalError(Exception):
    """Base of all errors raised by pincal."""

    exit_code = 1


class BadInputError(PincalError, ValueError):
    """Input that can't be used as it is: refused before any work is done."""

    exit_code = 3


class RobotFileError(BadInputError):
    """A URDF that can't be read or does not describe one serial arm from base to tip."""


class MeasurementError(BadInputError):
    """A table of measurements with a column, unit or value that can't be right."""


class ModelFileError(BadInputError):
    """A ``model.json`` that is cut off, inconsistent or written by a newer version."""


class OutputError(BadInputError):
    """An output file or folder that can't be written."""


class IdentificationError(PincalError, RuntimeError):
    """A fit that did not converge, or a rank problem that the user has to decide."""

    exit_code = 4


class AccuracyGateError(PincalError):
    """The held-out error exceeds the limit that the user set."""

    exit_code = 5


class PincalWarning(UserWarning):
    """Something that the user should know, but that does not stop the work."""
