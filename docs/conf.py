"""Sphinx configuration: `sphinx-build -W docs docs/_build` builds the site and executes every notebook.

`-D nb_execution_mode=off` leaves notebooks as they are: seconds instead of minutes.
"""

import functools
import re
import shutil
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import opfem

HERE = Path(__file__).resolve().parent
NOTEBOOKS = HERE.parent / "notebooks"

project = "opfem"
author = "opfem developers"
copyright = "opfem developers, MIT licence"
release = version = opfem.__version__

extensions = [
    "cyclopts.ext.sphinx",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath", "deflist", "fieldlist"]
myst_heading_anchors = 3

# Executed notebooks are kept in _build/.jupyter_cache until their code changes. They run in a folder of their own.
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 1500
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
default_role = "code"
smartquotes = False  # would spoil --options
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = ["Source"]

html_math_renderer = "mathml"  # read by browsers without a script, so that the site opens offline
html_theme = "pydata_sphinx_theme"
html_title = "opfem"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_sourcelink = False
html_sidebars = {page: [] for page in ("index", "start", "validation", "performance", "changes")}
html_theme_options = {
    "show_prev_next": True,
    "header_links_before_dropdown": 6,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


ALIASES = [
    (r"jaxlib\._jax\.Array", "Array"),
    (r"Array \| ndarray \| bool \| number \| bool \| int \| float \| complex", "ArrayLike"),
    (r"float \| int \| Float\[Array, ''\]", "ScalarLike"),
    (r"Key\[Array, ''\] \| UInt32\[Array, '2'\] \| UInt32\[Array, '4'\]", "PRNGKeyArray"),
]


def copy_notebooks(app: object) -> None:
    """Put the notebooks where Sphinx finds them; unchanged ones keep their time, so that they are not built again."""
    for notebook in NOTEBOOKS.glob("*.ipynb"):
        target = HERE / "tutorials" / notebook.name
        if not target.exists() or target.read_bytes() != notebook.read_bytes():
            shutil.copyfile(notebook, target)


def shorten(text: str) -> str:
    """Write array types as the source does: what they are made of is longer than a line."""
    return functools.reduce(lambda t, pair: re.sub(*pair, t), ALIASES, text)


def readable_types(app: object, what: str, name: str, obj: object, options: object, signature: str, returns: str):
    """Shorten types of signatures, and leave out those of numbers, which a converter takes in any form."""
    return tuple(text and re.sub(r"(?<=\w): Any\b", "", shorten(text)) for text in (signature, returns))


def first_line(app: object, what: str, name: str, obj: object, options: object, lines: list[str]):
    """Keep napoleon from reading what stands before a colon in a property's docstring as its type."""
    if what in ("property", "attribute"):
        lines.insert(0, "")


def readable_text(app: object, doctree: nodes.document):
    """Shorten types of properties, which are no signatures; set a dash between an argument and what it is."""
    for text in list(doctree.findall(nodes.Text)):
        if "jaxlib._jax." in text or text == " -- ":
            text.parent.replace(text, nodes.Text(shorten(text.astext()).replace(" -- ", " – ")))


def without_empty_outputs(app: object, doctree: nodes.document, page: str):
    """Leave out what a progress line was, which ends empty."""
    for block in list(doctree.findall(nodes.literal_block)):
        if "text_plain" in block["classes"] and not block.astext().strip():
            block.parent.remove(block)


def write_math(translator: object, node: nodes.Element):
    """Write a formula as MathML."""
    block = isinstance(node, nodes.math_block)
    formula = tex2mathml(node.astext(), as_block=block)
    translator.body.append(f'<div style="text-align: center; margin: 1em 0">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def plain_text(app: object, what: str, name: str, obj: object, options: object, lines: list[str]):
    """Escape what is no markup in docstrings: *KEYWORDS of Abaqus, |norms|, "*points" of types; `code` stays."""
    lines[:] = [re.sub(r"(`[^`]*`|\\.)|([*|])", lambda m: m[1] or "\\" + m[2], shorten(line)) for line in lines]


def setup(app):
    """Copy notebooks before Sphinx looks for pages; clean docstrings before and after napoleon, which comes at 500."""
    app.connect("builder-inited", copy_notebooks)
    app.connect("autodoc-process-signature", readable_types)
    app.connect("autodoc-process-docstring", first_line, priority=400)
    app.connect("autodoc-process-docstring", plain_text, priority=600)
    app.connect("doctree-read", readable_text)
    app.connect("doctree-resolved", without_empty_outputs)
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
