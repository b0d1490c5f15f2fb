"""How Sphinx builds the documentation: `make docs`."""

import re
from pathlib import Path

import uarm_rl

project = "uarm-rl"
author = "the uarm-rl authors"
version = release = uarm_rl.__version__
copyright = "the uarm-rl authors, MIT license"

extensions = [
    "myst_parser",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinxcontrib.mermaid",
]
myst_enable_extensions = ["attrs_block", "colon_fence"]
myst_heading_anchors = 4  # `page.md#a-heading`, as where the sources are read
myst_fence_as_directive = ["mermaid"]

html_theme = "furo"
html_title = "uarm-rl"
html_theme_options = {"source_directory": "docs/"}
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

# A page for each module, written anew with every build.
apidoc_modules = [
    {
        "path": "../uarm_rl",
        "destination": "api",
        "exclude_patterns": ["**/conf/**", "**/commands/**", "**/openmv/**", "**/__main__.py"],
        "separate_modules": True,
        "module_first": True,
        "max_depth": 2,
    }
]
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True


def setup(app):
    """`results.md` becomes `RESULTS.md`; the tables of the runs are files beside the site, not pages of it."""

    def read(_, page, source):
        if page == "results":
            text = (Path(__file__).parent.parent / "RESULTS.md").read_text()
            source[0] = re.sub(r"\]\((results/)", r"](../\1", text).replace("](docs/", "](")
        source[0] = re.sub(r"(?<!!)\[([^\]]*)\]\((\.\./results/[^)]*\.(?:md|csv))\)", r"{download}`\1 <\2>`", source[0])

    app.connect("source-read", read)
