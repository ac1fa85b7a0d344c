"""`uav-twin wing`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def wing(
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
    vtu: Annotated[Path | None, typer.Option(help="Write the wing with its fields for ParaView.")] = None,
) -> None:
    """Say what the wing weighs, how it vibrates and how stiff its tip is."""
    from fe.cache import reduced_model
    from rich.console import Console
    from rich.table import Table

    from fe.design import load_design
    from fe.state import DigitalState
    from reporting.progress import RichProgress

    wing_design = load_design(design)
    model = reduced_model(wing_design, progress=RichProgress())
    state = DigitalState()
    modes = model.modes(state.young_modulus_factor, state.stiffness_loss, state.servo_mass, state.pitot_mass)
    table = Table("figure", "this wing", "reference", "unit")
    table.add_row("tip stiffness", f"{1e-3 * model.tip_stiffness(1.0):.4f}", "0.6770", "N/mm")
    reference = {modes.flapwise[0]: "5.632", modes.flapwise[1]: "28.544"}
    names = {modes.flapwise[0]: ", first flapwise bending", modes.flapwise[1]: ", second flapwise bending"}
    for index, frequency in enumerate(modes.frequency):
        name = f"frequency {index + 1}{names.get(index, '')}"
        table.add_row(name, f"{frequency:.3f}", reference.get(index, ""), "Hz")
    console = Console(highlight=False)
    console.print(table)
