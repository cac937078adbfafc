"""Sphinx: `sphinx-build -W docs docs/_build` in an environment with `pip install '.[docs]'`."""

import shutil
import warnings
from pathlib import Path

import matplotlib

import apt_evap

HERE = Path(__file__).parent
GENERATED = HERE / "generated"

project = "apt_evap"
author = "The apt_evap developers"
copyright = author
release = version = apt_evap.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
]
default_role = "py:obj"
rst_prolog = r".. |v| replace:: \|v\|"  # docstrings write the magnitude of v as |v|
exclude_patterns = ["_build", "generated/scripts"]
templates_path = ["_templates"]

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
numpydoc_show_class_members = False

bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "alpha"

# examples write where they are run: not into the folder they are kept in
shutil.copytree(HERE.parent / "examples", GENERATED / "scripts", dirs_exist_ok=True)
matplotlib.use("agg")
warnings.filterwarnings("ignore", message=".*non-interactive.*")
sphinx_gallery_conf = {
    "examples_dirs": str(GENERATED / "scripts"),
    "gallery_dirs": str(GENERATED / "gallery"),
    "filename_pattern": r"/tutorial_",  # the figures of the paper take minutes: shown, not run
    "within_subsection_order": "ExampleTitleSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_title = f"apt_evap {version}"
html_theme_options = {"show_toc_level": 2, "secondary_sidebar_items": ["page-toc"]}
