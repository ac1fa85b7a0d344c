"""Compare the wing as a sandwich plate with the box: `python -m evidence.sandwich_plate`.

Call the command in a checkout of the project. `--design FILE` takes another design, `--quick` a
coarse mesh without limits on the differences. `docs/explanation/verification.md` has the results.
The exit code is 1 if a limit is broken.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from evidence.sandwich_plate.plate_comparison import DAMAGE, PlateAgreement, compare_with_plate
from evidence.sandwich_plate.plate_known_answers import (
    cantilever_strip,
    square_plate_deflection,
    square_plate_frequency,
)
from fe.verification.wing_checks import QUICK_REFINEMENTS, Check
from fe.wing.design import load_design
from fe.wing.operators import AffineOperators, assemble
from reporting import terminal
from twin_master.command import run_command_line
from uav_twin.check_table import exit_if_broken, print_checks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def compare(
    design: Annotated[
        Path | None, typer.Option(help="Wing design; the shipped one by default.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A coarser mesh, without limits on the differences.")
    ] = False,
) -> None:
    """Compare the sandwich plate with the box of a design, and with closed forms."""
    wing = load_design(design)
    mesh = wing.changed(mesh={"refinement": QUICK_REFINEMENTS[0]}) if quick else wing
    checks = list(plate_checks(assemble(mesh), limited=not quick))
    print_checks(checks)
    exit_if_broken(checks)


def plate_checks(operators: AffineOperators, *, limited: bool = True) -> Iterator[Check]:
    """Yield the closed forms of the sandwich plate, and its differences to the box of a design.

    Strain jumps at the edge of a defect. So the gauges whose patch comes near an edge are also
    listed apart, without a limit. They count in the root mean square of all gauges; that of the
    other gauges has a tighter limit.

    Parameters
    ----------
    operators : AffineOperators
        The box.
    limited : bool
        Whether the differences have limits, which are made for the mesh of the design.
    """
    closed_forms = {
        "square plate, deflection": square_plate_deflection,
        "square plate, first frequency": square_plate_frequency,
        "strip, tip deflection": cantilever_strip,
    }
    for name, closed_form in closed_forms.items():
        yield Check("sandwich plate", name, abs(closed_form(8).relative_error), 1e-3)
    for straight, group in ((False, "plate against box"), (True, "plate of the box's section")):
        agreement = compare_with_plate(
            operators.wing_mesh.design, operators, straight_section=straight
        )
        yield from _figure_checks(agreement, group, limited=limited)
        yield from _gauge_checks(agreement, operators.regions, group, limited=limited)
        yield from _size_checks(agreement, group)


def _figure_checks(agreement: PlateAgreement, group: str, *, limited: bool) -> Iterator[Check]:
    """Yield the differences of single figures."""
    units = {"tip_stiffness": "N/m", "first_bending": "Hz", "second_bending": "Hz"}
    for name, unit in units.items():
        plate_figure = getattr(agreement.plate, name)
        box_figure = getattr(agreement.box, name)
        note = f"({plate_figure:.5g}, {box_figure:.5g} {unit})"
        limit = 0.01 if limited else None
        yield Check(group, name.replace("_", " "), abs(agreement.relative(name)), limit, note)
    plate_slope = agreement.plate.tip_stiffness_slope
    box_slope = agreement.box.tip_stiffness_slope
    note = f"({plate_slope:.4f}, {box_slope:.4f})"
    limit = 0.02 if limited else None
    yield Check(group, "d ln k / d ln e", abs(agreement.tip_stiffness_slope), limit, note)


def _gauge_checks(
    agreement: PlateAgreement, regions: Sequence[str], group: str, *, limited: bool
) -> Iterator[Check]:
    """Yield the differences of strains: of all gauges, of those off edges, of those at edges."""
    differences = {
        "gauges": agreement.strain,
        "d ln strain / d ln e": agreement.strain_slope,
    }
    for region, ratio_difference in zip(regions, agreement.damage_ratio, strict=True):
        differences[f"strain ratio, {region} = {DAMAGE:g}"] = ratio_difference
    every_gauge = np.arange(len(agreement.at_edges))
    off_edges = np.flatnonzero(~agreement.at_edges)
    at_edges = np.flatnonzero(agreement.at_edges)
    for name, difference in differences.items():
        all_limit = 0.03 if limited else None
        off_edges_limit = 0.02 if limited else None
        yield from _rms_checks(group, f"{name}, rms", difference, every_gauge, all_limit)
        yield from _rms_checks(
            group, f"{name}, rms off the edges", difference, off_edges, off_edges_limit
        )
        if len(at_edges):
            texts = [f"{gauge + 1}: {100 * difference[gauge]:+.1f} %" for gauge in at_edges]
            note = f"({', '.join(texts)})"
            largest = float(np.abs(difference[at_edges]).max())
            yield Check(group, f"{name}, largest at the edges", largest, None, note)


def _rms_checks(
    group: str, name: str, difference: FloatArray, gauges: IntArray, limit: float | None
) -> Iterator[Check]:
    """Yield the root mean square of the differences of chosen gauges; nothing without gauges.

    Parameters
    ----------
    group, name : str
        Group and name of the check.
    difference : (G,) array
        Differences of all gauges.
    gauges : (g,) array
        Numbers of the chosen gauges.
    limit : float or None
        Limit of the root mean square.
    """
    if not len(gauges):
        return
    rms = float(np.sqrt(np.mean(difference[gauges] ** 2)))
    worst = gauges[np.abs(difference[gauges]).argmax()]
    largest = abs(difference[worst])
    note = f"({len(gauges)} gauges, largest {largest:.2g}, gauge {worst + 1})"
    yield Check(group, name, rms, limit, note)


def _size_checks(agreement: PlateAgreement, group: str) -> Iterator[Check]:
    """Yield the differences of the higher frequencies, and the ratio of the unknowns."""
    ratio = agreement.plate.frequency[3:] / agreement.box.frequency[3:] - 1.0
    percentages = [f"{100 * value:+.1f} %" for value in ratio]
    note = f"({', '.join(percentages)})"
    largest = float(np.abs(ratio).max())
    yield Check(group, f"frequencies 4 to {3 + len(ratio)}", largest, None, note)
    unknown_ratio = agreement.plate.unknowns / agreement.box.unknowns
    yield Check(group, "unknowns, over those of the box", unknown_ratio)


def main() -> None:
    """Run `python -m evidence.sandwich_plate`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(compare)
    run_command_line(
        lambda: terminal.with_common_options(application)(
            prog_name="python -m evidence.sandwich_plate"
        )
    )


if __name__ == "__main__":
    main()
