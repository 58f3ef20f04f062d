"""Exports: the calibrated robot in formats of controllers, simulators and other programs.

The modules register one :class:`pincal.export.exported.Format` each, or several; satellites hand in
further ones.
"""

import pkgutil
from importlib import import_module

from pincal.export.exported import FORMATS, Exported, Format, export_model

__all__ = ["FORMATS", "Exported", "Format", "export_model"]

for _module in pkgutil.iter_modules(__path__, __name__ + "."):
    import_module(_module.name)
