"""Options that several commands have."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def refuse_before(context: typer.Context) -> None:
    """Refuse options that stand before a sub-command, which would not see them; raises `BadParameter`."""
    sources = map(context.get_parameter_source, context.params)
    if any(source is not None and source.name == "COMMANDLINE" for source in sources):
        raise typer.BadParameter(
            f"options go behind the command: {context.info_name} {context.invoked_subcommand} ..."
        )


Replace = Annotated[bool, typer.Option("--replace", help="Replace a file that exists.")]
Design = Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")]
Effects = Annotated[
    list[Path] | None,
    typer.Option("--effects", help="A TOML file of further effects; may be given several times."),
]
ModelFile = Annotated[
    str | None, typer.Option(help="As of `discrepancy run`.", show_default="the shipped wing")
]
Kind = Annotated[
    Literal["python", "compiled", "source"],
    typer.Option(help="Run by Python, compiled C, or C sources to be compiled elsewhere."),
]
FmiVersion = Annotated[
    int, typer.Option("--fmi", min=2, max=3, help="Version of FMI: 3 for compiled and source.")
]
StepTimeout = Annotated[float | None, typer.Option(help="Wall-clock limit of a step in seconds.", min=0.0)]
