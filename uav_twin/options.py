"""Arguments and options that several commands share, and the completion of names by the shell.

They are annotations of parameters for Typer. Names of what is shipped are completed; where no name
fits, the shell itself completes the paths of files.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

import discrepancy
from reporting.terminal import LARGEST_SEED
from scenarios import structure_files

if TYPE_CHECKING:
    from fmu_asset.compiled.platforms import Platform


def _names_beginning_with(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with the typed text."""
    return [name for name in names if name.startswith(incomplete)]


def complete_structure(incomplete: str) -> list[str]:
    """Return the shipped structures whose names begin with the typed text."""
    return _names_beginning_with(incomplete, structure_files())


def complete_model(incomplete: str) -> list[str]:
    """Return the shipped lumped models and structures whose names begin with the typed text."""
    # The folder is listed, because an import of its package would take long
    folder = Path(discrepancy.__file__).parent / "lumped_models"
    lumped_models = sorted(file.stem for file in folder.glob("*.toml"))
    return _names_beginning_with(incomplete, [*lumped_models, *structure_files()])


def complete_effect(incomplete: str) -> list[str]:
    """Return the effects of the catalogue whose identifiers begin with the typed text."""
    from discrepancy.catalogue.library import load_catalogue

    return _names_beginning_with(incomplete, [effect.identifier for effect in load_catalogue()])


CampaignArgument = Annotated[
    Path, typer.Argument(show_default=False, help="Folder with campaign.toml.")
]
FmuArgument = Annotated[Path, typer.Argument(show_default=False, help="An FMU.")]
SspArgument = Annotated[Path, typer.Argument(show_default=False, help="An SSP file.")]
StructureArgument = Annotated[
    Path,
    typer.Argument(
        show_default=False,
        autocompletion=complete_structure,
        help="A structure file (TOML) beside its mesh or matrices, or a shipped one.",
    ),
]

DesignOption = Annotated[
    Path | None, typer.Option("--design", help="Wing design; the shipped one by default.")
]
EffectFilesOption = Annotated[
    list[Path] | None,
    typer.Option("--effects", help="A TOML file of further effects; may be given several times."),
]
FmiOption = Annotated[
    int,
    typer.Option("--fmi", min=2, max=3, help="Version of FMI: 3 for compiled and source."),
]
FmuKind = Literal["python", "compiled", "source"]
FmuKindOption = Annotated[
    FmuKind,
    typer.Option(
        "--kind", help="Run by Python, compiled C, or C sources to be compiled elsewhere."
    ),
]
PlatformsOption = Annotated[
    str | None,
    typer.Option(
        "--platforms",
        metavar="NAMES",
        show_default="this host, by its C compiler",
        help="Platforms of a compiled FMU, such as linux64,win64,darwin64; all for all. Needs the "
        "extra cross.",
    ),
]
InProcessOption = Annotated[
    bool,
    typer.Option("--in-process", help="Faster, without protection from crashes and endless steps."),
]
InterpolationOption = Annotated[
    str | None,
    typer.Option(
        "--interpolation",
        help="How inputs go on between communication points: zero-order or linear; by default as "
        "the binding says, and zero-order in a system.",
    ),
]
MemoryLimitOption = Annotated[
    float | None,
    typer.Option(
        "--memory-limit",
        min=0.1,
        help="GiB that it may take; what the machine has left by default.",
    ),
]
ModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        show_default="the shipped wing",
        autocompletion=complete_model,
        help="The same as for `discrepancy run`.",
    ),
]
ModeCountOption = Annotated[int, typer.Option("--modes", min=1, max=50, help="Number of modes.")]
HistoryOption = Annotated[
    Path | None,
    typer.Option("--out", help="The file to write: CSV, or NetCDF (.nc) with units."),
]
PlotOption = Annotated[
    Path | None,
    typer.Option("--plot", help="A picture of the outputs to write: .png or .svg."),
]
ReplaceOption = Annotated[bool, typer.Option("--replace", help="Replace a file that exists.")]
SampleSeedOption = Annotated[
    int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of all samples.")
]
StepSizeOption = Annotated[
    float | None,
    typer.Option(
        "--step-size",
        min=0.0,
        help="Communication step size in seconds; the FMU's own by default.",
    ),
]
StepTimeoutOption = Annotated[
    float | None,
    typer.Option("--step-timeout", min=0.0, help="Wall-clock limit of a step in seconds."),
]


def split_platforms(names: str | None) -> "list[Platform] | None":
    """Return the platforms that `--platforms` names, separated by commas.

    Whoever takes the list checks its names.
    """
    if names is None:
        return None
    return cast("list[Platform]", [name.strip() for name in names.split(",")])
