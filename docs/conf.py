"""Sphinx: `sphinx-build -W docs docs/_build` in an environment with `pip install '.[docs]'`."""

import shutil
import warnings
from pathlib import Path

import matplotlib
from PIL import Image

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
    "sphinx_design",
]
SECTIONS = ("start", "background", "evidence", "development")  # pages that only list other pages
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

# examples write files to the folder where they run: run copies, not the originals
shutil.copytree(HERE.parent / "examples", GENERATED / "scripts", dirs_exist_ok=True)
matplotlib.use("agg")
warnings.filterwarnings("ignore", message=".*non-interactive.*")
sphinx_gallery_conf = {
    "examples_dirs": str(GENERATED / "scripts"),
    "gallery_dirs": str(GENERATED / "gallery"),
    "filename_pattern": r"/tutorial_",  # the figures of the paper take minutes and are not run
    "within_subsection_order": "ExampleTitleSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "write_computation_times": False,
}

# pictures of the cards on the front page: parts of figures, given by left, upper, right and lower fractions
CARDS = {
    "first_map": ("ni111.png", (0.555, 0.12, 0.895, 0.86)),
    "accuracy": ("figure7.png", (0.50, 0.05, 0.985, 0.362)),
    "results": ("figure6.png", (0.711, 0.10, 0.939, 0.453)),
    "physics": ("figure2.png", (0.555, 0.048, 0.895, 0.26)),
    "code": ("figure2.png", (0.064, 0.045, 0.424, 0.30)),
}
(GENERATED / "cards").mkdir(parents=True, exist_ok=True)
for name, (figure, (left, upper, right, lower)) in CARDS.items():
    picture = Image.open(HERE / figure)
    width, height = picture.size
    box = (round(left * width), round(upper * height), round(right * width), round(lower * height))
    picture.crop(box).save(GENERATED / "cards" / f"{name}.png")

html_theme = "pydata_sphinx_theme"
html_title = f"apt_evap {version}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_sourcelink = False
# no empty columns: the front page has no sidebars, and pages that only list other pages have no table of contents
html_sidebars = {"index": [], "search": [], "genindex": []}
html_theme_options = {
    "show_toc_level": 2,
    "show_nav_level": 2,
    "navigation_with_keys": False,
    "secondary_sidebar_items": {"**": ["page-toc"], "index": [], **{section: [] for section in SECTIONS}},
}
