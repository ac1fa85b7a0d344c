"""The table of variables of a structure's FMU. Copied into the FMU."""

from __future__ import annotations

from collections.abc import Mapping

from fe.runtime.reduced import ReducedModel

from ..companions.table import Table
from ..slaves.variables import QUASI_STATIC, TRANSIENT, FmuVariable

RESERVED = ("response", "status", "strain_error_bound", "displacement_error_bound")
"""Names that controls and parameters of a structure cannot have: its FMU has variables of that name."""


def structure_table(model: ReducedModel, start: Mapping[str, float]) -> tuple[FmuVariable, ...]:
    """Return the table: controls and health as inputs, parameters, outputs by name, modal outputs, status.

    Parameters
    ----------
    model : ReducedModel
        The reduced structure.
    start : mapping of str to float
        Start values by variable name that take the place of the nominal ones.

    Raises
    ------
    ValueError
        If a start value is of no input or parameter, or a name is one of `RESERVED`.
    """
    for name in (*model.controls, *model.parameters):
        if name in RESERVED:
            raise ValueError(f"a structure with an FMU can have no control or parameter named {name!r}")
    table = Table(start)
    nominal = dict(zip(model.chosen, model.nominal.tolist(), strict=True))
    for name, unit in zip(model.controls, model.control_units.split(), strict=True):
        table.add(
            name,
            "input",
            f"Control {name} of the loads",
            unit=unit,
            box=model.validity[name],
            default=nominal[name],
        )
    for name in model.regions:
        table.add(
            f"health.{name}", "input", f"Stiffness that the region {name} has lost, as a fraction",
            unit="1", display="%", box=model.validity[name],
        )  # fmt: skip
    for name in model.parameters:
        table.add(
            name, "parameter", f"Factor {name} on the stiffness", unit="1",
            box=model.validity[name], default=nominal[name],
        )  # fmt: skip
    for name in model.masses:
        table.add(
            f"mass.{name}", "parameter", f"Mass of {name}", unit="kg", display="g",
            box=model.validity[name], default=nominal[name],
        )  # fmt: skip
    alpha, beta = model.damping.tolist()
    table.add(
        "damping.alpha", "parameter", "Mass-proportional Rayleigh damping",
        unit="1/s", box=(0.0, None), default=alpha,
    )  # fmt: skip
    table.add(
        "damping.beta", "parameter", "Stiffness-proportional Rayleigh damping",
        unit="s", box=(0.0, None), default=beta,
    )  # fmt: skip
    table.add(
        "response", "parameter", "Quasi-static (1) or transient (2)", kind="Enumeration",
        box=(QUASI_STATIC, TRANSIENT), default=QUASI_STATIC, enumeration="Response",
    )  # fmt: skip
    for name in model.gauges:
        table.add(
            f"strain.{name}", "output", f"Strain at gauge {name}, positive in tension",
            unit="1", display="microstrain",
        )  # fmt: skip
    for name in model.displacements:
        table.add(f"displacement.{name}", "output", f"Displacement {name}", unit="m", display="mm")
    for name in model.accelerations:
        table.add(
            f"acceleration.{name}", "output", f"Acceleration {name}; zero where the response is quasi-static",
            unit="m/s2",
        )  # fmt: skip
    bound = "Certified bound of the error of any static {} against the full finite element model"
    table.add("strain_error_bound", "output", bound.format("strain"), unit="1", display="microstrain")
    table.add("displacement_error_bound", "output", bound.format("displacement"), unit="m", display="mm")
    for mode in range(1, model.mode_count + 1):
        table.add(f"frequency[{mode}]", "output", f"Natural frequency of mode {mode}", unit="Hz")
    for mode in range(1, model.mode_count + 1):
        table.add(f"damping_ratio[{mode}]", "output", f"Damping ratio of mode {mode}", unit="1", display="%")
    table.add("status", "output", "What became of the last call", kind="Enumeration", enumeration="Status")
    return table.rows()
