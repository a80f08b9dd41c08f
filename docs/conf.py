"""Settings of Sphinx, which renders the documentation: ``make docs``.

The source folder is the repository, so that links between pages are the same in a checkout and in the
rendered documentation. Pages of the reference are generated before the sources are read (`reference_pages`).
"""

from __future__ import annotations

import gc
import json
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS))

import reference_pages  # noqa: E402 - a package beside this file
from docutils import nodes  # noqa: E402
from reference_pages import api  # noqa: E402
from sphinx import addnodes  # noqa: E402
from sphinx.domains.python import PythonDomain  # noqa: E402
from sphinx.ext.napoleon import Config  # noqa: E402

from caviar_services.registry import scenario_schema  # noqa: E402

project = "CAVIAR"
author = copyright = "The CAVIAR developers"  # noqa: A001 - Sphinx's name
release = version = metadata.version("caviar-sim")

extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = ["docs/**", "protocol/**", "CHANGELOG.md", "CONTRIBUTING.md"]
exclude_patterns = [".*", "build", "runs", "node_modules", "**/__pycache__", "protocol/caviar_protocol"]
suppress_warnings = [
    "myst.header",  # SPEC.md and pages of one topic begin where they like
    "ref.python",  # a class of the same name in two modules: the reader chooses by the module
]
nitpicky = False  # names in docstrings may be those of other libraries

# Nearly all of the objects of a document stay: a search for garbage among all of them finds little.
gc.set_threshold(100_000, 20, 100)

# --- Markdown ---
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

# --- API reference ---
default_role = "py:obj"
add_module_names = False
autodoc_default_options = {
    "members": True,
    "member-order": "bysource",
    "show-inheritance": True,
    "ignore-module-all": True,  # a class is shown where it is defined
}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_use_type_comments = False  # there are none, and looking for them reads the source of every function
maximum_signature_line_length = 88

# --- HTML ---
html_theme = "furo"
html_title = f"CAVIAR {release}"
html_static_path = ["_static"]
html_css_files = ["caviar.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"
pygments_dark_style = "monokai"
highlight_language = "none"


class QuickPythonDomain(PythonDomain):
    """The Python domain, which looks for a name among those that end with its last word.

    Sphinx compares every name of every signature (``int``, ``str``) with each of some thousand objects.
    """

    _found: dict[str, Any] | None = None

    @property
    def objects(self) -> dict[str, Any]:
        """Objects by full name; within `find_obj`, those that may be meant."""
        return super().objects if self._found is None else self._found

    def find_obj(
        self, env: Any, modname: Any, classname: Any, name: str, kind: Any, searchmode: int = 0
    ) -> Any:
        """Objects that a name may mean."""
        if len(self.objects) != getattr(self, "_counted", -1):
            self._counted = len(self.objects)
            self._by_last_word: dict[str, dict[str, Any]] = {}
            for full, entry in self.objects.items():
                self._by_last_word.setdefault(full.rpartition(".")[2], {})[full] = entry
        self._found = self._by_last_word.get(name.removesuffix("()").rpartition(".")[2], {})
        try:
            return super().find_obj(env, modname, classname, name, kind, searchmode)
        finally:
            self._found = None


def setup(app: Any) -> None:
    """Connect the generators of the reference."""
    for name, default, rebuild, types in Config._config_values:  # `api.finish_docstring` calls Napoleon
        app.add_config_value(name, default, rebuild, types)
    app.config.napoleon_use_rtype = False
    app.add_domain(QuickPythonDomain, override=True)
    app.connect("builder-inited", lambda app: reference_pages.generate(Path(app.srcdir)))
    app.connect("autodoc-process-bases", api.shorten_bases)
    app.connect("autodoc-process-signature", api.hide_signature)
    app.connect("autodoc-skip-member", api.hide_fields)
    app.connect("autodoc-process-docstring", api.finish_docstring)
    app.connect("doctree-read", drop_plain_bases)
    app.connect("html-page-context", shorten_navigation, priority=400)  # before the theme asks for it
    app.connect("build-finished", write_files_beside_pages)


def shorten_navigation(app: Any, page: str, template: str, context: dict[str, Any], _: Any) -> None:
    """Make the navigation, which has titles of pages alone, without a copy of all that stands on them.

    Sphinx copies the table of contents of every page, with each function, for every page, and removes what is
    below the titles then: a quarter of the time of a build.
    """
    whole: Any = context.get("toctree")

    def toctree(**options: Any) -> Any:
        contents = app.env.tocs
        app.env.tocs = titles(app.env)
        try:
            return whole(**options)
        finally:
            app.env.tocs = contents

    if whole is not None:
        context["toctree"] = toctree


@cache
def titles(env: Any) -> dict[str, nodes.bullet_list]:
    """Tables of contents by page, with its title and the pages below it alone."""
    found = {page: contents.copy() for page, contents in env.tocs.items()}
    for page, short in found.items():
        for item in env.tocs[page].children:  # a title, and what stands below it
            below = [tree.copy() for child in item.children[1:] for tree in child.findall(addnodes.toctree)]
            short += item.copy()
            short[-1] += [title.deepcopy() for title in item.children[:1]]
            short[-1] += [nodes.bullet_list("", *below)] if below else []
    return found


def drop_plain_bases(app: Any, doctree: nodes.document) -> None:
    """Remove the line of base classes where it names `object` alone."""
    for paragraph in list(doctree.findall(nodes.paragraph)):
        if paragraph.astext() == "Bases: object" and paragraph.parent is not None:
            paragraph.parent.remove(paragraph)


def write_files_beside_pages(app: Any, error: Exception | None) -> None:
    """Write ``index.html``, which leads to the first page below ``docs``, and the schema of scenarios."""
    if error is None and app.builder.format == "html":
        folder, target = Path(app.outdir), f"{root_doc}.html"
        (folder / "index.html").write_text(
            f'<!doctype html><meta charset="utf-8"><title>{project}</title>'
            f'<meta http-equiv="refresh" content="0; url={target}"><a href="{target}">{project}</a>\n'
        )
        schema = json.dumps(scenario_schema(), indent=1, ensure_ascii=False)
        (folder / "scenario.schema.json").write_text(f"{schema}\n", "utf-8")
