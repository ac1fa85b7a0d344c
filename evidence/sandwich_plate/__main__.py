"""The wing once more, as a sandwich plate beside the box: `python -m evidence.sandwich_plate`.

Called in a checkout of the project. `--design FILE` takes another design, `--quick` a coarse mesh and no
limits on the differences. `docs/explanation/verification.md` says what came out. Ends with 1 if a limit is
broken.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from evidence.sandwich_plate.plate_comparison import DAMAGE, compare_with_plate
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


def compare(
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
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
    """Yield the closed forms of the sandwich plate, and its differences to the box of the same design.

    Gauges whose patch comes near an edge of a defect count in the rms of all gauges; they are told apart,
    without a limit of their own, because strain jumps there. The rms of the others has a tighter limit.

    Parameters
    ----------
    operators : AffineOperators
        The box.
    limited : bool
        Hold the differences to their limits, which are made for the mesh of the design.
    """
    for name, closed_form in (
        ("square plate, deflection", square_plate_deflection),
        ("square plate, first frequency", square_plate_frequency),
        ("strip, tip deflection", cantilever_strip),
    ):
        yield Check("sandwich plate", name, abs(closed_form(8).relative_error), 1e-3)
    for straight, group in ((False, "plate against box"), (True, "plate of the box's section")):
        found = compare_with_plate(operators.wing_mesh.design, operators, straight_section=straight)
        for name, unit in (("tip_stiffness", "N/m"), ("first_bending", "Hz"), ("second_bending", "Hz")):
            note = f"({getattr(found.plate, name):.5g}, {getattr(found.box, name):.5g} {unit})"
            limit = 0.01 if limited else None
            yield Check(group, name.replace("_", " "), abs(found.relative(name)), limit, note)
        slopes = f"({found.plate.tip_stiffness_slope:.4f}, {found.box.tip_stiffness_slope:.4f})"
        limit = 0.02 if limited else None
        yield Check(group, "d ln k / d ln e", abs(found.tip_stiffness_slope), limit, slopes)
        for name, difference in (
            ("gauges", found.strain),
            ("d ln strain / d ln e", found.strain_slope),
            *(
                (f"strain ratio, {name} = {DAMAGE:g}", difference)
                for name, difference in zip(operators.regions, found.damage_ratio, strict=True)
            ),
        ):
            for kind, gauges, limit in (
                ("rms", np.arange(len(difference)), 0.03),
                ("rms off the edges", np.flatnonzero(~found.at_edges), 0.02),
            ):
                if len(gauges):
                    rms = float(np.sqrt(np.mean(difference[gauges] ** 2)))
                    worst = gauges[np.abs(difference[gauges]).argmax()]
                    note = f"({len(gauges)} gauges, largest {abs(difference[worst]):.2g}, gauge {worst + 1})"
                    yield Check(group, f"{name}, {kind}", rms, limit if limited else None, note)
            at_edges = np.flatnonzero(found.at_edges)
            if len(at_edges):
                each = (f"{gauge + 1}: {100 * difference[gauge]:+.1f} %" for gauge in at_edges)
                note = f"({', '.join(each)})"
                largest = float(np.abs(difference[at_edges]).max())
                yield Check(group, f"{name}, largest at the edges", largest, None, note)
        ratio = found.plate.frequency[3:] / found.box.frequency[3:] - 1.0
        note = f"({', '.join(f'{100 * value:+.1f} %' for value in ratio)})"
        yield Check(group, f"frequencies 4 to {3 + len(ratio)}", float(np.abs(ratio).max()), None, note)
        yield Check(group, "unknowns, over those of the box", found.plate.unknowns / found.box.unknowns)


def main() -> None:
    """Run `python -m evidence.sandwich_plate`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(compare)
    run_command_line(
        lambda: terminal.with_common_options(application)(prog_name="python -m evidence.sandwich_plate")
    )


if __name__ == "__main__":
    main()
