"""The earlier place of :mod:`pincal.sensors.registry`, for one release."""

from pincal.plugins import of_moved_module

__getattr__ = of_moved_module(__name__, "pincal.sensors.registry")
