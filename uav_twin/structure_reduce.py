"""`uav-twin structure reduce`."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal
from uav_twin.structure_arguments import File, MemoryLimit, assembled_of_any, reduced

if TYPE_CHECKING:
    from fe.reduction.structure_errors import MeasuredErrors
    from fe.runtime.reduced import ReducedModel


def reduce(
    file: File,
    states: Annotated[
        int, typer.Option(min=0, max=1000, help="Random states at which it is compared with the full model.")
    ] = 4,
    memory_limit: MemoryLimit = None,
    json: terminal.Json = False,
) -> None:
    """Make the reduced model of a structure, keep it in the cache, and measure its errors."""
    from fe.reduction.structure_errors import measured_errors

    model, errors = reduced(file, memory_limit), None
    if states:
        structure = assembled_of_any(file, memory_limit)
        with terminal.progress().stage("Comparing it with the full model"):
            errors = measured_errors(structure, model, states)
    if json:
        terminal.print_json(
            {
                "name": model.name,
                "design_hash": model.design_hash,
                "static_basis": len(model.static_load.T),
                "modal_basis": len(model.modal_load.T),
                "ranges": {name: list(ends) for name, ends in model.validity.items()},
                "errors": None if errors is None else asdict(errors),
            }
        )
        return
    headings = ("what", "name", "least", "nominal", "largest")
    terminal.print_table(headings, list(_ranges(model)))
    terminal.say(
        f"{model.name}: {len(model.static_load.T)} static and {len(model.modal_load.T)} modal basis vectors; "
        f"gauges {len(model.gauges)}, displacements {len(model.displacements)}, "
        f"accelerations {len(model.accelerations)}, modes {model.mode_count}."
    )
    if errors is not None:
        heading = f"largest error at {errors.states} random states"
        terminal.print_table(("of", heading), list(_errors(errors)))


def _ranges(model: "ReducedModel") -> Iterator[tuple[str, ...]]:
    kinds = dict.fromkeys(model.parameters, "parameter") | dict.fromkeys(model.regions, "stiffness loss")
    kinds |= dict.fromkeys(model.masses, "mass [kg]")
    units = model.control_units.split()
    kinds |= {name: f"control [{unit}]" for name, unit in zip(model.controls, units, strict=True)}
    for (name, (low, high)), nominal in zip(model.validity.items(), model.nominal, strict=True):
        yield kinds[name], name, f"{low:g}", f"{nominal:g}", f"{high:g}"


def _errors(errors: "MeasuredErrors") -> Iterator[tuple[str, str]]:
    for what, value in (
        ("strains, of the largest", errors.strain),
        ("displacements, of the largest", errors.displacement),
        ("certified bound of both", errors.bound),
        ("frequencies", errors.frequency),
    ):
        if value == value:  # not where there are no such outputs
            yield what, f"{value:.2g}"
    yield "states in which an error exceeds its bound", f"{errors.broken}"
