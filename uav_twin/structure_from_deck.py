"""`uav-twin structure from-deck`."""

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from reporting import terminal
from reporting.files import explained_write_errors, refuse_filled
from reporting.progress import stage
from reporting.terminal import JsonOption

if TYPE_CHECKING:
    from fe.solver_deck.comparison import DeckReport


def from_deck(
    deck: Annotated[Path, typer.Argument(show_default=False, help="A deck of CalculiX (.inp).")],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the structure, which must be empty; by default the deck's name "
            "without suffix, beside the deck.",
        ),
    ] = None,
    length_unit: Annotated[
        Literal["mm", "m"],
        typer.Option(
            "--length-unit", help="Unit of the deck: mm (N, mm, s, t) or m (N, m, s, kg)."
        ),
    ] = "mm",
    region: Annotated[
        list[str] | None,
        typer.Option(
            "--region",
            help="A set of elements that may lose stiffness; may be given up to eight times. By "
            "default every set that has a section.",
        ),
    ] = None,
    output: Annotated[
        list[str] | None,
        typer.Option(
            "--output",
            help="A set of nodes whose mean displacement is an output, also along some axes alone, "
            "as TIP:z; may be given several times. By default the first twelve sets that can move.",
        ),
    ] = None,
    contact: Annotated[
        Literal["tied", "open"],
        typer.Option("--contact", help="What becomes of contact pairs."),
    ] = "tied",
    preload: Annotated[
        Literal["tangent", "none"],
        typer.Option(
            "--preload",
            help="What becomes of static steps before a step with PERTURBATION: the stiffness at "
            "their end, or that of the unloaded structure.",
        ),
    ] = "tangent",
    time_limit: Annotated[
        float,
        typer.Option("--time-limit", min=1.0, help="Seconds that one run of CalculiX may take."),
    ] = 600.0,
    tolerance: Annotated[
        float,
        typer.Option(
            "--tolerance",
            min=1e-9,
            max=0.1,
            help="Largest relative difference to displacements and frequencies of CalculiX.",
        ),
    ] = 1e-5,
    json: JsonOption = False,
) -> None:
    """Convert a CalculiX deck to a structure, and compare it with CalculiX' own results.

    Example: `uav-twin structure from-deck wing_box.inp --region SKIN --output TIP`
    """
    from fe.solver_deck.conversion import DeckOptions, convert_deck
    from fe.solver_deck.regions import name_in_file

    folder = deck.with_suffix("") if out is None else out
    refuse_filled(folder)
    name = name_in_file(deck.stem)
    if not name[0].isalpha():
        name = f"deck_{name}"
    options = DeckOptions(
        length_unit=length_unit,
        regions=region or (),
        outputs=output or (),
        contact=contact,
        preload=preload,
        time_limit=time_limit,
        tolerance=tolerance,
    )
    # All is made in a scratch folder, so that a refused deck leaves nothing half-written.
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        with stage("CalculiX on the deck"):
            report = convert_deck(deck, Path(scratch), name, options)
        shutil.rmtree(Path(scratch) / "calculix")
        with explained_write_errors(folder):
            shutil.copytree(scratch, folder, dirs_exist_ok=True)
    file = folder / f"{name}.toml"
    if json:
        terminal.print_json(_record(file, report))
    else:
        _print_report(file, report, tolerance)


def _record(file: Path, report: "DeckReport") -> dict[str, object]:
    """Return the results of the command as data."""
    return {
        "structure": str(file),
        "unknowns": report.unknowns,
        "regions": {region.name: len(region.elements) for region in report.regions},
        "displacement_deviation": report.load_deviations,
        "frequencies": report.frequencies.tolist() if report.has_mass else [],
        "frequency_deviation": report.frequency_deviation,
        "remarks": report.remarks,
    }


def _print_report(file: Path, report: "DeckReport", tolerance: float) -> None:
    """Print the structure, its agreement with CalculiX, and what is linearised or left out."""
    from fe.solver_deck.regions import COMPARED_DENSITY

    terminal.say(f"{file}: {report.unknowns:,} unknowns")
    for region in report.regions:
        terminal.say(
            f"region {region.name}: {len(region.elements):,} elements of {region.set_name}"
        )
    rows = [
        (f"displacements under {name}", f"{value:.1e}", f"{report.load_limits[name]:.0e}")
        for name, value in report.load_deviations.items()
    ]
    if len(report.frequencies):
        frequency_row = f"{len(report.frequencies)} frequencies from {report.frequencies[0]:.6g} Hz"
        if not report.has_mass:
            frequency_row = (
                f"{len(report.frequencies)} frequencies with a density of {COMPARED_DENSITY}"
            )
        rows.append((frequency_row, f"{report.frequency_deviation:.1e}", f"{tolerance:.0e}"))
    if rows:
        terminal.print_table(("of", "deviation from CalculiX", "limit"), rows)
    for remark in report.remarks:
        terminal.say(f"note: {remark}.")
