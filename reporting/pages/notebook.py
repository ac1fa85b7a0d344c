"""What results show in a notebook: a table as HTML, and panels for pictures.

Pictures of notebooks are made with pyplot, unlike those of reports: a user of xarray or pandas
expects that a picture appears without a further call, and that panels of a figure of one's own can
be handed in.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

if TYPE_CHECKING:  # matplotlib takes long to import, and tables do not need it
    from matplotlib.axes import Axes

MOST_ROWS = 30
"""Most rows of a table; a line says how many more there are."""


def html_table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[object]], notes: Iterable[str] = ()
) -> str:
    """Return a table as HTML, with escaped text.

    Parameters
    ----------
    title : str
        A line above the table.
    headings : sequence of str
        The headings of the columns; none are shown if all are empty.
    rows : iterable of sequence
        The cells of each row.
    notes : iterable of str
        Sentences below the table.
    """
    all_rows = list(rows)
    lines = [Markup("<div><b>{}</b>").format(title), Markup("<table>")]
    if any(headings):
        cells = Markup("").join(Markup("<th>{}</th>").format(text) for text in headings)
        lines.append(Markup("<tr>{}</tr>").format(cells))
    for row in all_rows[:MOST_ROWS]:
        cells = Markup("").join(Markup("<td>{}</td>").format(str(cell)) for cell in row)
        lines.append(Markup("<tr>{}</tr>").format(cells))
    lines.append(Markup("</table>"))
    if len(all_rows) > MOST_ROWS:
        lines.append(Markup("<p>and {} more</p>").format(len(all_rows) - MOST_ROWS))
    for note in notes:
        lines.append(Markup("<p>{}</p>").format(escape(note)))
    return "\n".join([*lines, "</div>"])


def new_panels(count: int, axes: "Axes | Sequence[Axes] | None" = None) -> "list[Axes]":
    """Return the panels of a picture: those of the user, or new ones of pyplot in one column.

    Parameters
    ----------
    count : int
        The number of panels.
    axes : Axes or sequence of Axes, optional
        The panels of the user.

    Raises
    ------
    ValueError
        If another number of panels was given.
    """
    if axes is None:
        from matplotlib import pyplot

        height = 0.8 + 1.9 * count
        _figure, panels = pyplot.subplots(
            count, 1, figsize=(7.2, height), squeeze=False, layout="constrained"
        )
        return list(panels.ravel())
    from matplotlib.axes import Axes as MatplotlibAxes

    panels_of_user = [axes] if isinstance(axes, MatplotlibAxes) else list(axes)
    if len(panels_of_user) != count:
        raise ValueError(
            f"The picture has {count} panels, but {len(panels_of_user)} were given as `axes`."
        )
    return panels_of_user
