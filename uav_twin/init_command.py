"""`uav-twin init`: a project of one's own in one command."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from reporting.choices import require_one_of

KINDS = ("mesh", "fmu", "rig", "stream")
"""The kinds of projects."""


def init(
    kind: Annotated[
        str,
        typer.Argument(
            show_default=False,
            help="mesh: a twin of a part; fmu: a twin of any FMU; rig: what the model of a rig "
            "lacks; stream: a real asset that is watched.",
        ),
    ],
    folder: Annotated[Path, typer.Argument(show_default=False, help="The folder to make.")],
    file: Annotated[
        Path | None,
        typer.Argument(
            show_default="a shipped example",
            help="Your file: a mesh, an FMU, a ring-down as CSV, or the structure file of a part.",
        ),
    ] = None,
) -> None:
    """Make a folder that runs at once, with your file in it: comments at each key, and a README of five commands.

    Example: `uav-twin init mesh my_part part.inp`
    """  # noqa: E501
    from uav_twin.projects.fmu import fmu_project
    from uav_twin.projects.mesh import mesh_project
    from uav_twin.projects.rig import rig_project
    from uav_twin.projects.stream import stream_project

    require_one_of(kind, KINDS, "KIND")
    makers = {
        "mesh": mesh_project,
        "fmu": fmu_project,
        "rig": rig_project,
        "stream": stream_project,
    }
    with terminal.progress().stage("Writing the project"):
        project = makers[kind](folder.resolve().name, file)
        project.write(folder)
    terminal.say(f"Wrote {folder}: {project.title}")
    terminal.say(f"Next: cd {folder}, and the commands of README.md:")
    for command, _ in project.commands:
        terminal.say(f"  {command}")
