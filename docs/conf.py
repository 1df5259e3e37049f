"""Sphinx configuration; `make docs` builds the pages and runs the tutorials."""

import re

from docutils.nodes import TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import autdtorch

project = "autdtorch"
author = "The autdtorch authors"
copyright = "the autdtorch authors; MIT licence"
version = release = autdtorch.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
nitpicky = True
nitpick_ignore_regex = [  # not described here
    ("py:class", r"(?!autdtorch\.).*"),
    ("py:class", r"autdtorch\.(utils\.mirror_images|fdtd\.resonances|methods\.calibration\.fit)\..*"),
]
default_role = "py:obj"

html_theme = "furo"
html_title = f"autdtorch {version}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_js_files = ["accessible.js"]
html_copy_source = False
html_show_sourcelink = False

myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 300
nb_merge_streams = True

autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "special-members": "__call__"}
autodoc_preserve_defaults = True
autodoc_type_aliases = {
    "ArrayLike": "autdtorch.utils.validation.ArrayLike",
    "GoalFunction": "autdtorch.objectives.objective.GoalFunction",
    "Trials": "autdtorch.methods.seeds.Trials",
    "Vector": "autdtorch.utils.validation.Vector",
}
add_module_names = False
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
napoleon_numpy_docstring = False
napoleon_use_ivar = True


def escape(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Keep |q| and np.bool_ in docstrings from being read as reStructuredText's references."""
    lines[:] = [re.sub(r"\||_(?=[]),]|$)", r"\\\g<0>", line) for line in lines]


def name_aliases(
    app: Sphinx,
    what: str,
    name: str,
    thing: object,
    options: object,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """Write an alias within a union by its name; Sphinx 9.0 writes its own placeholder."""
    placeholder = re.compile(r"TypeAliasForwardRef\('([\w.]+)'\)")
    return tuple(part and placeholder.sub(r"\1", part) for part in (signature, returns))


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: TextElement) -> TextElement | None:
    """Link public names, wherever they are defined, to `autdtorch.name`; other `code` is no reference."""
    if node.get("refdomain") != "py":
        return None
    public = "autdtorch." + node["reftarget"].rpartition(".")[-1]
    domain = env.domains.python_domain
    if public in domain.objects:
        return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, shown)
    return shown if node["reftype"] == "obj" else None


def setup(app: Sphinx) -> None:
    """Connect the above."""
    app.connect("autodoc-process-docstring", escape)
    app.connect("autodoc-process-signature", name_aliases)
    app.connect("missing-reference", resolve)
