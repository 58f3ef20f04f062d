"""Programs of robot controllers: read, corrected and written so that nothing but their numbers
changes.

Each controller's language is one module that registers a
:class:`pincal.programs.language.ControllerLanguage`.
"""

import pkgutil
from importlib import import_module

from pincal.programs.language import LANGUAGES, language_of

__all__ = ["LANGUAGES", "language_of"]

for _module in pkgutil.iter_modules(__path__, __name__ + "."):
    import_module(_module.name)
