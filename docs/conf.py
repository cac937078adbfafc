"""Sphinx: `sphinx-build -W docs docs/_build` in an environment with `pip install '.[docs]'`."""

import apt_evap

project = "apt_evap"
author = "The apt_evap developers"
copyright = author
release = version = apt_evap.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "numpydoc"]
default_role = "py:obj"
rst_prolog = r".. |v| replace:: \|v\|"  # docstrings write the magnitude of v as |v|
exclude_patterns = ["_build"]
templates_path = ["_templates"]

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = f"apt_evap {version}"
html_theme_options = {"show_toc_level": 2, "secondary_sidebar_items": ["page-toc"]}
