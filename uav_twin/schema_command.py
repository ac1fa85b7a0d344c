"""The command on the formats of files."""

from pathlib import Path
from typing import Annotated

import typer

from reporting.terminal import JsonOption


def _complete_format(incomplete: str) -> list[str]:
    """Return the formats whose names begin with the typed text."""
    from uav_twin.formats import FORMATS

    return [name for name in FORMATS if name.startswith(incomplete)]


def schema(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="FORMAT",
            show_default=False,
            autocompletion=_complete_format,
            help="A format; without one all formats are listed.",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="The file to write, for an editor.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Print the JSON Schema of a file format, or list the formats.

    Example: `uav-twin schema campaign --out campaign.schema.json`
    """
    from reporting.files import atomic_write_text
    from reporting.terminal import print_json
    from uav_twin.formats import FORMATS, find_format

    if name is None:
        if out is not None:
            raise typer.BadParameter("name the format to write.", param_hint="--out")
        if json:
            print_json({key: entry.title for key, entry in FORMATS.items()})
            return
        width = 2 + max(map(len, FORMATS))
        for entry in FORMATS.values():
            title = entry.title.replace("`", "")
            typer.echo(f"{entry.name:{width}}{entry.notation.upper()}  {title}")
        return
    file_format = find_format(name)
    text = file_format.schema_text()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, text)
    typer.echo(f"{out} is written.")
    if file_format.notation == "toml":
        typer.echo(f"First line of a TOML file beside it: #:schema ./{out.name}")
