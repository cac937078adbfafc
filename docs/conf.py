"""Sphinx: `sphinx-build -W docs docs/_build` in an environment with `pip install '.[docs]'`."""

import html
import re
import shutil
import sys
import warnings
from pathlib import Path

import matplotlib
import ziamath
from docutils.nodes import SkipNode

import apt_evap

HERE = Path(__file__).parent
GENERATED = HERE / "generated"
sys.path.insert(0, str(HERE))

import generate  # noqa: E402

project = "apt_evap"
author = "The apt_evap developers"
copyright = author
release = version = apt_evap.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
]
SECTIONS = ("tutorials", "howto/index", "physics", "reference", "validation", "results/index", "development")
default_role = "py:obj"
smartquotes = False  # texts in quotes are values to copy
# docstrings write the magnitude of v as |v|; names in `single backticks` are those of the package
rst_prolog = r""".. |v| replace:: \|v\|

.. py:currentmodule:: apt_evap

"""
exclude_patterns = ["_build", "generated/scripts"]
templates_path = ["_templates"]

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "none"  # the docstrings have the types
numpydoc_show_class_members = False

bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "alpha"

generate.api(GENERATED / "api")
generate.commands(GENERATED / "commands.inc")
generate.settings(GENERATED / "settings.inc")
generate.materials(GENERATED / "materials.inc")
generate.atlas(GENERATED / "atlas.html")
generate.dataset_fields(GENERATED / "dataset_fields.inc")
generate.thumbnails(GENERATED / "thumbnails")

# examples write files to the folder where they run: run copies, not the originals
shutil.copytree(HERE.parent / "examples", GENERATED / "scripts", dirs_exist_ok=True)
matplotlib.use("agg")
warnings.filterwarnings("ignore", message=".*non-interactive.*")
sphinx_gallery_conf = {
    "examples_dirs": str(GENERATED / "scripts"),
    "gallery_dirs": str(GENERATED / "gallery"),
    "filename_pattern": r"/tutorial_",  # the other examples need a measured file
    "ignore_pattern": r"visible_pairs",  # belongs to a settings file
    "within_subsection_order": "ExampleTitleSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "write_computation_times": False,
}

copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp"

html_theme = "pydata_sphinx_theme"
html_math_renderer = "pictures"  # below: no script, and nothing from a network
html_title = f"apt_evap {version}"
html_logo = "_static/logo.svg"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_sourcelink = False
# no empty columns: the front page has no sidebars, and pages that only list other pages have no table of contents
html_sidebars = {"index": [], "search": [], "genindex": []}
html_theme_options = {
    "logo": {"text": "apt_evap"},
    "header_links_before_dropdown": 8,
    "show_toc_level": 2,
    "show_nav_level": 1,
    "navigation_with_keys": False,
    "secondary_sidebar_items": {"**": ["page-toc"], "index": [], **{section: [] for section in SECTIONS}},
}


def in_package(app, env, node, contnode):
    """Link to a public name, also without its namespace or with its module, and to the class of a field."""
    if node.get("reftype") != "obj":
        return None
    node["py:module"], node["py:class"] = "apt_evap", None
    python, target = env.domains["py"], node["reftarget"].removeprefix("apt_evap.")
    names = [target, target.rpartition(".")[0], re.sub(r"^([a-z_]+)\.[a-z_]+\.", r"\1.", target)]
    for name in filter(None, names):
        for place in ("", *(f"{space}." for space in generate.namespaces())):
            found = python.resolve_xref(env, node["refdoc"], app.builder, "obj", place + name, node, contnode)
            if found is not None:
                return found
    return None


ziamath.config.svg2 = False  # every picture has its own letters


def formula(text, inline):
    """Formula as an SVG in the colour of the text, on its line."""
    drawn = ziamath.Latex(" ".join(text.split()), size=17, color="currentColor", inline=inline)  # px
    attributes = f'role="img" aria-label="{html.escape(text)}" style="vertical-align: {drawn.getyofst():.2f}px"'
    return drawn.svg().replace("<svg ", f"<svg {attributes} ", 1)


def inline_formula(self, node):
    """Draw a formula in a line."""
    self.body.append(formula(node.astext(), True))
    raise SkipNode


def displayed_formula(self, node):
    """Draw formulas between paragraphs; empty lines separate them."""
    for text in filter(str.strip, node.astext().split("\n\n")):
        self.body.append(f'<div class="formula">{formula(text, False)}</div>\n')
    raise SkipNode


def setup(app):
    app.add_html_math_renderer("pictures", (inline_formula, None), (displayed_formula, None))
    app.connect("missing-reference", in_package)
