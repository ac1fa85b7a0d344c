"""The command `uav-twin compare`: the earnings of fleets and ensembles, side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal
from reporting.terminal import JsonOption

if TYPE_CHECKING:
    from twin_master.fleet.comparison import Statistics


def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(
            show_default=False,
            help="Folders of fleets or ensembles.",
        ),
    ],
    *,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Draw the returns of all flights, as SVG or PNG.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compare fleets or ensembles: what they earned, their controls, alarms and errors.

    Flights of the same seed meet the same damage and noise, so that returns are compared seed by
    seed with those of the first folder.

    Example: `uav-twin compare runs/fleet runs/other_fleet`
    """
    from reporting.pages.figures import write_picture
    from twin_master.fleet.comparison import compare_fleets, groups_of_fleets, returns_of_group
    from twin_master.fleet.page.page_figures import returns_figure

    figures = compare_fleets(folders)
    if picture is not None:
        returns = {named.name: returns_of_group(named.group) for named in groups_of_fleets(folders)}
        write_picture(picture, returns_figure(returns))
    if json:
        terminal.print_json(figures)
    else:
        print_figures(figures)


def print_figures(figures: "Statistics") -> None:
    """Print a table of results with a column for each group."""
    from twin_master.fleet.comparison import statistic_rows

    rows = statistic_rows(figures)
    if rows:
        terminal.print_table(["result", *figures], rows)
