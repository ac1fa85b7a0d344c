"""The texts of a page that are too long for code: titles, captions and sentences in a TOML file."""

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING

from reporting.pages.page import ReportFigure
from reporting.pages.table import PageColumn, Table, number_column
from reporting.pages.templates import fill_template

if TYPE_CHECKING:  # text is made without figures, too, and matplotlib takes long to import
    from matplotlib.figure import Figure


class Words:
    """The texts of a page, from a TOML file: Jinja2 templates with plain ``{{ fields }}``.

    ``[said]`` holds sentences by name, ``[figures]`` titles and captions, ``[tables]`` titles,
    captions and, where a table always has the same, columns. A column is a heading of text, or a
    table with the heading of `number` and its `unit`.

    Parameters
    ----------
    package : str
        The package of the file, such as ``twin_master.report``.
    name : str
        The name of the file.
    """

    def __init__(self, package: str, name: str = "words.toml") -> None:
        file = resources.files(package).joinpath(name)
        self.content = tomllib.loads(file.read_text(encoding="utf-8"))

    def say(self, name: str, /, **fields: object) -> str:
        """Return a sentence of the table ``[said]``."""
        return fill_template(self.content["said"][name], **fields)

    def words(self, kind: str, name: str, /, **fields: object) -> dict[str, str]:
        """Return the title and the caption of one of the `figures` or `tables`."""
        texts = self.content[kind][name]
        return {key: fill_template(texts[key], **fields) for key in ("title", "caption")}

    def figure(self, name: str, figure: "Figure", /, **fields: object) -> ReportFigure:
        """Return a figure with its title and caption."""
        return ReportFigure(name, figure, **self.words("figures", name, **fields))

    def table(
        self,
        name: str,
        rows: Sequence[Sequence[str]],
        /,
        columns: Sequence[PageColumn] = (),
        **fields: object,
    ) -> Table:
        """Return a table with its title and caption.

        Parameters
        ----------
        name : str
            The name of the table in the file.
        rows : sequence of sequence of str
            The cells of each row.
        columns : sequence of PageColumn
            The columns after those that the file has.
        **fields : object
            The fields of title, caption and headings.
        """
        headings = self.content["tables"][name].get("columns", ())
        first_columns = [_column_of_heading(heading, fields) for heading in headings]
        return Table([*first_columns, *columns], rows, **self.words("tables", name, **fields))


def _column_of_heading(heading: str | dict[str, str], fields: Mapping[str, object]) -> PageColumn:
    """Return the column that a heading in the file of texts describes, with fields filled in."""
    if isinstance(heading, str):
        return PageColumn(fill_template(heading, **fields))
    return number_column(fill_template(heading["number"], **fields), heading.get("unit", ""))
