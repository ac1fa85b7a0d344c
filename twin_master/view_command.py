"""`uav-twin view`: of a run, a watch or a fleet."""

import webbrowser
from pathlib import Path

import typer


def view(folder: Path, *, port: int = 0, browser: bool = False) -> None:
    """Show a flight in the browser, turn by turn or while it goes on, or a whole fleet."""
    from twin_master.fleet.report import is_fleet, serve_fleet
    from twin_master.viewer.server import serve

    def ready(address: str) -> None:
        typer.echo(f"{folder}: {address} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(address)

    (serve_fleet if is_fleet(folder) else serve)(folder, port, ready)
