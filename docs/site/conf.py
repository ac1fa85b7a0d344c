"""The site of the documentation: the Markdown of the folder above, ordered by `index.md` beside this file."""

import inspect
from pathlib import Path

import jupyter_client
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.environment import BuildEnvironment
from traitlets import CaselessStrEnum

import uav_twin

DOCS = Path(__file__).resolve().parent.parent

project = "uav-twin"
author = "The uav-twin authors"
root_doc = "index"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["site/index.md"]
default_role = "code"
highlight_language = "none"

myst_heading_anchors = 5
myst_enable_extensions = ["colon_fence"]

# Each notebook runs in an empty folder; what it prints and draws is on its page, and an error ends the build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True


class _EncryptedKernels(jupyter_client.AsyncKernelManager):
    """Kernels whose messages are encrypted; those of the default warn that theirs are not."""

    transport_encryption = CaselessStrEnum(["disabled", "auto", "required"], default_value="auto")


jupyter_client.AsyncKernelManager = _EncryptedKernels  # nbclient takes no configuration from Sphinx

napoleon_google_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "none"
maximum_signature_line_length = 100

html_theme = "pydata_sphinx_theme"
html_title = "uav-twin"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_theme_options = {"show_prev_next": True, "navbar_align": "left", "secondary_sidebar_items": ["page-toc"]}


def _front(text: str) -> str:
    """Return the front page, with the tables by role and by task of the page that code hosts show."""
    opening, mark, contents = (
        (DOCS / "site" / "index.md").read_text(encoding="utf-8").partition("```{toctree}")
    )
    tables = text[text.index("## By role") :]
    return f"{opening}{tables}\n## All pages\n\n{mark}{contents}"


def _interface(text: str) -> str:
    """Return the page of the interface: every name of `uav_twin.__all__` from its docstring."""
    entries = []
    for name in uav_twin.__all__:
        found = getattr(uav_twin, name)
        if inspect.isclass(found):
            entries.append(f".. autoclass:: uav_twin.{name}\n   :members:")
        elif callable(found):
            entries.append(f".. autofunction:: uav_twin.{name}")
    body = "\n\n".join(entries)
    return f"{text}\n```{{eval-rst}}\n{body}\n```\n"


def _gallery(text: str) -> str:
    """Return the page of pictures: one for each effect, leading to its page."""
    pictures = []
    for page in sorted((DOCS / "reference" / "effects").glob("[!R]*.md")):
        title = page.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        picture = f"![{title}](../reference/effects/images/{page.stem}.png)"
        pictures.append(
            f"- [{picture}](../reference/effects/{page.name})\n  [{title}](../reference/effects/{page.name})"
        )
    return f"{text}\n:::{{container}} gallery\n" + "\n".join(pictures) + "\n:::\n"


MADE = {"index": _front, "site/api": _interface, "site/gallery": _gallery}
"""Pages that are made, or stand in the place of what is read on a code host."""


def _make(app: Sphinx, name: str, source: list[str]) -> None:
    if name in MADE:
        source[0] = MADE[name](source[0])


def _spread(app: Sphinx, env: BuildEnvironment, names: list[str]) -> None:
    """Put pages between the notebooks, which take nearly all of the time: a process reads a row of pages."""
    notebooks = [name for name in names if "file_format: mystnb" in env.doc2path(name).read_text("utf-8")]
    pages = [name for name in names if name not in notebooks]
    for place, notebook in enumerate(notebooks):
        pages.insert(place * len(names) // len(notebooks), notebook)
    names[:] = pages


def _keep_printed_tables(app: Sphinx, tree: nodes.document) -> None:
    """Mark the tables in what commands print, whose lines scroll while lines of text wrap.

    A table reaches from the line above its rule of dashes to the next line that is not indented.
    """
    for block in tree.findall(nodes.literal_block):
        lines = block.astext().splitlines(keepends=True)
        heads = [number - 1 for number, line in enumerate(lines) if set(line.strip()) == {"─"}]
        if not heads or heads[0] < 0:
            continue
        block.children.clear()
        first = 0
        for head in heads:
            end = head + 2
            while end < len(lines) and lines[end].startswith(" ") and lines[end].strip():
                end += 1
            for text, classes in ((lines[first:head], []), (lines[head:end], ["printed-table"])):
                block += nodes.inline("", "".join(text), classes=classes)
            first = end
        block += nodes.inline("", "".join(lines[first:]))
        block.rawsource = ""  # other than the text: Sphinx then writes the parts as they are


def _mark_tables_of_keys(app: Sphinx, tree: nodes.document) -> None:
    """Mark the tables of the file formats, whose second column has sentences."""
    if app.env.docname.startswith("reference/formats/"):
        for table in tree.findall(nodes.table):
            table["classes"].append("keys")


def _quiet(app: Sphinx, config: Config) -> None:
    """Accept that the language of a notebook is not known where its kernel is not asked."""
    if config.nb_execution_mode == "off":
        config.suppress_warnings.append("myst-nb.lexer")


def setup(app: Sphinx) -> None:
    """Make the pages of `MADE` where Sphinx reads them, and let processes share the notebooks."""
    app.connect("config-inited", _quiet)
    app.connect("source-read", _make)
    app.connect("env-before-read-docs", _spread)
    app.connect("doctree-read", _keep_printed_tables)
    app.connect("doctree-read", _mark_tables_of_keys)
