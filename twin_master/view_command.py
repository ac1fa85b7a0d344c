"""`uav-twin view`: of a run, a watch or a fleet."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer


def view(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="Folder of a run, a watch or a fleet, finished or going on.",
            show_default=False,
        ),
    ],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on the loopback.", show_default="any that is free")
    ] = 0,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in the default browser.")] = False,
) -> None:
    """Show a flight in the browser, turn by turn or while it goes on, or a whole fleet."""
    from twin_master.fleet.view import is_fleet, serve_fleet
    from twin_master.viewer.server import serve

    def ready(address: str) -> None:
        typer.echo(f"{folder}: {address} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(address)

    (serve_fleet if is_fleet(folder) else serve)(folder, port, ready)
