"""How Sphinx makes pages of these documents: `make docs`."""

from physxnet_jax import __version__

project = "physxnet_jax"
author = "The physxnet_jax authors"
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
html_theme = "sphinx_book_theme"
html_title = "physxnet_jax"
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# Results and sources that pages point to are files of the repository, not pages.
suppress_warnings = ["myst.xref_missing"]
