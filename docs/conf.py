"""Settings of the site: ``python -m sphinx -W docs build/site``."""

import importlib.metadata
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

project = "pincal"
author = "the pincal maintainers"
copyright = "2026, the pincal maintainers"
release = importlib.metadata.version("pincal")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["pages.py", "conf.py"]
html_theme = "furo"
html_title = f"pincal {release}"
html_copy_source = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
highlight_language = "text"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
# The architecture page's recipes are marked by comments; a link may name a file of the repository.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
napoleon_use_ivar = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Distinguished by", "Source"]
copybutton_prompt_text = "$ "


def _inline(page: Any, node: nodes.math) -> None:
    page.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(page: Any, node: nodes.math_block) -> None:
    page.body.append(f"<p>{convert(node.astext(), display='block')}</p>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Write formulas as MathML, which browsers draw without a script from anywhere."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
