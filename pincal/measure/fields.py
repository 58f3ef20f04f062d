"""The earlier place of :mod:`pincal.sensors.fields`, for one release."""

from pincal.plugins import of_moved_module

__getattr__ = of_moved_module(__name__, "pincal.sensors.fields", "pincal.measure.table_schema")
