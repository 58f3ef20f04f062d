"""Settings of the site: ``python -m sphinx -W docs build/site``."""

import importlib.metadata

project = "pincal"
author = "the pincal maintainers"
copyright = "2026, the pincal maintainers"
release = importlib.metadata.version("pincal")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx_copybutton"]
exclude_patterns = ["pages.py", "conf.py"]
html_theme = "furo"
html_title = f"pincal {release}"
html_copy_source = False

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
# The architecture page's recipes are marked by comments; a link may name a file of the repository.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
napoleon_use_ivar = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Told apart by", "Source"]
copybutton_prompt_text = "$ "
