"""Sphinx configuration: sphinx-build -W -b html docs docs/_build/html."""

import inspect
import os
import re

from sphinx.util.inspect import stringify_signature
from torchrl.objectives import LossModule

import torchrl_osr

project = "torchrl-osr"
author = "The torchrl-osr authors"
copyright = "2026, The torchrl-osr authors"
version = release = torchrl_osr.__version__

extensions = [
    "myst_nb",  # pages in Markdown, and the tutorials, which are executed
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    # MathJax itself, so that formulas need no network either.
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "torchrl-osr"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["tables.css"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 2

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 80
add_module_names = False

# A link to a name of ours that is not in the reference is an error.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!torchrl_osr\b).*")]

# Links into the neighbours' documentation need a network, and the build shall not.
if os.environ.get("TORCHRL_OSR_DOCS_ONLINE"):
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "tensordict": ("https://pytorch.org/tensordict/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "torchrl": ("https://pytorch.org/rl/stable", None),
    }


def constructor_signature(app, what, name, obj, options, signature, returns):
    """Show a loss's own arguments; TorchRL's metaclass has them as ``*args``."""
    if what == "class" and issubclass(obj, LossModule):
        own = inspect.signature(obj.__init__)
        own = own.replace(parameters=list(own.parameters.values())[1:])
        return stringify_signature(own, show_annotation=False), None
    return None


SEVERAL_NAMES = re.compile(r"(?m)^:(keyword|ivar) (\w+(?:, \w+)+): (.*(?:\n+ +.*)*)")


def one_field_each(app, what, name, obj, options, lines):
    """Make of ``:ivar low, high:`` one field for each name; Napoleon does for Args."""

    def split(match):
        role, names, meaning = match.groups()
        return "\n".join(f":{role} {each}: {meaning}" for each in names.split(", "))

    lines[:] = SEVERAL_NAMES.sub(split, "\n".join(lines)).split("\n")


def setup(app):
    app.connect("autodoc-process-signature", constructor_signature)
    # After Napoleon, whose priority is 500.
    app.connect("autodoc-process-docstring", one_field_each, priority=600)
