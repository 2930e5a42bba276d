"""Sphinx configuration: sphinx-build -W -b html docs docs/_build/html."""

import inspect
import os
import pkgutil
import re
import shutil
import sys
from pathlib import Path

from docutils import nodes
from sphinx.util.inspect import stringify_signature
from torchrl.objectives import LossModule

import torchrl_osr

sys.path.insert(0, str(Path(__file__).parent))
import settings

project = "torchrl-osr"
author = "The torchrl-osr authors"
copyright = "2026, The torchrl-osr authors"
version = release = torchrl_osr.__version__

extensions = [
    "myst_parser",  # pages in Markdown
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    # MathJax itself: formulas need no network.
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

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 80
add_module_names = False

# A link to a name of ours that does not exist is an error.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!torchrl_osr\b).*"),
    ("py:.*", r".*\.(_AcceptedKeys|Array)"),  # in annotations
]

# Links into other projects' documentation need a network, which a build must not.
if os.environ.get("TORCHRL_OSR_DOCS_ONLINE"):
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "tensordict": ("https://pytorch.org/tensordict/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "torchrl": ("https://pytorch.org/rl/stable", None),
    }

GENERATED = Path(__file__).parent / "generated"
REFERENCE = """# {title}

```{{eval-rst}}
{body}
```
"""


def rooms():
    """Directives for all public modules, by the page on which they are documented."""
    pages = {}
    for found in pkgutil.walk_packages(torchrl_osr.__path__, "torchrl_osr."):
        parts = found.name.split(".")[1:]
        if any(part.startswith("_") for part in parts) or parts[:2] == ["lab", "cli"]:
            continue
        depth = 2 if parts[0] == "lab" else 1
        # A package's exported names are documented where they are defined.
        members = "" if found.ispkg else "\n   :members:"
        directive = f".. automodule:: {found.name}{members}\n"
        pages.setdefault(".".join(parts[:depth]), []).append(directive)
    del pages["lab"]
    return pages


def write_pages(app):
    """Write the settings and the reference, a page for each room, before the build."""
    GENERATED.mkdir(exist_ok=True)
    lines = ["# API reference\n", "*What does each name do?*\n"]
    lines += ["```python", "from torchrl_osr import OSRLoss, load_policy", "```\n"]
    lines += ["`torchrl_osr` exports these names:\n", "| name | |", "|---|---|"]
    for name in torchrl_osr.__all__:
        if not name.startswith("_"):
            summary = inspect.getdoc(getattr(torchrl_osr, name)).partition("\n")[0]
            summary = re.sub(r":math:`(.*?)`", r"$\1$", summary)
            lines.append(f"| {{py:obj}}`~torchrl_osr.{name}` | {summary} |")
    lines += ["\n## Modules\n", "`torchrl_osr.lab` needs the extra `train`."]
    lines += ["\n```{toctree}\n:maxdepth: 1\n", *rooms(), "```\n"]
    pages = {"settings": settings.page(), "reference": "\n".join(lines)}
    for page, directives in rooms().items():
        body = "\n".join(directives)
        pages[page] = REFERENCE.format(title=f"torchrl_osr.{page}", body=body)
    for page, text in pages.items():
        (GENERATED / f"{page}.md").write_text(text, encoding="utf-8")


def remove_pages(app, exception):
    """Leave nothing of a build outside of its output."""
    shutil.rmtree(GENERATED)


def resolve_exported_name(app, env, node, contnode):
    """Resolve a link to a name that a package exports: it is where it is defined."""
    domain, parts = env.get_domain("py"), node.get("reftarget", "").split(".")
    if parts[0] != "torchrl_osr":
        return None
    # A class with its member, or a single name, below the package.
    first = next((i for i, part in enumerate(parts) if part[:1].isupper()), -1)
    package, name = ".".join(parts[:first]) + ".", "." + ".".join(parts[first:])
    found = [each for each in domain.objects if each.endswith(name)]
    found = [each for each in found if each.startswith(package)]
    return found and domain.resolve_xref(
        env, node["refdoc"], app.builder, "obj", min(found, key=len), node, contnode
    )


def label_cells(app, doctree, docname):
    """Name the columns in the cells of wide tables: on a phone a row is a block."""
    for table in doctree.findall(nodes.table):
        head, *rows = [[*row.findall(nodes.entry)] for row in table.findall(nodes.row)]
        columns = zip(head, *rows, strict=True)
        if sum(max(len(each.astext()) for each in cells) for cells in columns) < 70:
            continue
        table["classes"].append("wide")
        for row in rows:
            for title, cell in zip(head[1:], row[1:], strict=True):
                label = nodes.inline(text=f"{title.astext()}: ", classes=["label"])
                paragraph = cell.next_node(nodes.paragraph)
                if cell.astext() and title.astext():
                    paragraph.insert(0, label)


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
    app.connect("builder-inited", write_pages)
    app.connect("doctree-resolved", label_cells)
    app.connect("build-finished", remove_pages)
    app.connect("missing-reference", resolve_exported_name)
    app.connect("autodoc-process-signature", constructor_signature)
    # After Napoleon, whose priority is 500.
    app.connect("autodoc-process-docstring", one_field_each, priority=600)
