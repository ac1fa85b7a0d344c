"""The one table of the wing FMU's variables.

The model description, the slave, the documentation and the shipped binding all follow this table.
Standard library only: the file is copied into the FMU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

Kind = Literal["Real", "Integer", "Boolean", "Enumeration"]
Causality = Literal["input", "parameter", "output", "local", "independent"]
Variability = Literal["continuous", "discrete", "fixed", "tunable"]

QUASI_STATIC = 1
"""Value of `response`: the steady turn, inertia and damping left out."""
TRANSIENT = 2
"""Value of `response`: the modes are integrated in time."""

STATUS_OK = 0
STATUS_OUTSIDE_RANGE = 1
STATUS_NOT_FINITE = 2
STATUS_BAD_STEP = 3
STATUS_BAD_CALL = 4
STATUS_BAD_STATE = 5
STATUS_INTERNAL = 6


@dataclass(frozen=True)
class EnumerationType:
    """Names and values of an enumeration: `items` maps a name to its value and description."""

    name: str
    description: str
    items: tuple[tuple[str, int, str], ...]


ENUMERATIONS = (
    EnumerationType(
        "Response",
        "How the wing answers its loads",
        (
            ("quasi_static", QUASI_STATIC, "The steady turn: static equilibrium with the inputs of the step"),
            ("transient", TRANSIENT, "The modes are integrated exactly, inputs held over the step"),
        ),
    ),
    EnumerationType(
        "Status",
        "What became of the last call; other than ok, the call was refused and state and outputs stay",
        (
            ("ok", STATUS_OK, "The outputs belong to the inputs of the last step"),
            ("outside_range", STATUS_OUTSIDE_RANGE, "An input or parameter lies outside its min and max"),
            ("not_finite", STATUS_NOT_FINITE, "An input or parameter is NaN or infinite"),
            ("bad_step", STATUS_BAD_STEP, "Step size or communication point is not acceptable"),
            ("bad_call", STATUS_BAD_CALL, "A call in the wrong phase, such as a step before initialisation"),
            ("bad_state", STATUS_BAD_STATE, "A restored state does not belong to this FMU"),
            ("internal", STATUS_INTERNAL, "The computation failed; the log says how"),
        ),
    ),
)


@dataclass(frozen=True)
class Unit:
    """A unit, its SI exponents and its display units.

    Attributes
    ----------
    name : str
        As in the model description.
    exponents : tuple of (str, int)
        Exponents of SI base units; the factor to them is one.
    displays : tuple of (str, float)
        Display units with the factor f of display = f * value.
    """

    name: str
    exponents: tuple[tuple[str, int], ...] = ()
    displays: tuple[tuple[str, float], ...] = ()


UNITS = (
    Unit("1", (), (("microstrain", 1e6), ("%", 100.0))),
    Unit("m", (("m", 1),), (("mm", 1000.0),)),
    Unit("kg", (("kg", 1),), (("g", 1000.0),)),
    Unit("N", (("kg", 1), ("m", 1), ("s", -2))),
    Unit("s", (("s", 1),)),
    Unit("1/s", (("s", -1),)),
    Unit("Hz", (("s", -1),)),
)


@dataclass(frozen=True)
class FmuVariable:
    """One row of the table.

    Attributes
    ----------
    name : str
        Name in the structured naming convention.
    reference : int
        FMI value reference; also the index of the row.
    kind : {"Real", "Integer", "Boolean", "Enumeration"}
        FMI base type; enumerations are read and set as integers.
    causality, variability : str
        As FMI 2.0 defines them.
    description : str
        One line for people.
    unit, display_unit : str or None
        Of `UNITS`.
    minimum, maximum : float or None
        The range that is enforced for inputs and parameters; None where there is none.
    start : float or None
        Start value of inputs and parameters.
    enumeration : str or None
        Name in `ENUMERATIONS`.
    """

    name: str
    reference: int
    kind: Kind
    causality: Causality
    variability: Variability
    description: str
    unit: str | None = None
    display_unit: str | None = None
    minimum: float | None = None
    maximum: float | None = None
    start: float | None = None
    enumeration: str | None = None


# Linear kinematics: half a metre at the tip of a wing of 1.8 m is already generous.
TIP_DISPLACEMENT_LIMIT = 0.5


def variable_table(
    *,
    gauge_count: int,
    mode_count: int,
    regions: Sequence[str],
    validity: Mapping[str, tuple[float, float]],
    start: Mapping[str, float],
) -> tuple[FmuVariable, ...]:
    """Return the table of the wing FMU: inputs, parameters, strains, other outputs, modal outputs.

    Parameters
    ----------
    gauge_count : int
        Number of strain gauges.
    mode_count : int
        Number of modes of which frequency and damping ratio are given.
    regions : sequence of str
        Names of the damage regions, in their order.
    validity : mapping of str to (float, float)
        The validity box of the reduced model: young_modulus_factor, the losses of the regions, load_factor,
        tip_force [N], servo_mass [kg], pitot_mass [kg].
    start : mapping of str to float
        Start values by variable name; a missing name starts at its default.

    Returns
    -------
    tuple of FmuVariable
        In order of the value reference.
    """
    rows: list[FmuVariable] = []

    def add(
        name: str,
        causality: Causality,
        description: str,
        *,
        unit: str | None = None,
        display: str | None = None,
        box: tuple[float | None, float | None] = (None, None),
        default: float | None = None,
        enumeration: str | None = None,
    ) -> None:
        variability: Variability = "fixed" if causality == "parameter" else "continuous"
        rows.append(
            FmuVariable(
                name=name,
                reference=len(rows),
                kind="Real" if enumeration is None else "Enumeration",
                causality=causality,
                variability="discrete" if enumeration and causality == "output" else variability,
                description=description,
                unit=unit,
                display_unit=display,
                minimum=box[0],
                maximum=box[1],
                start=None if causality == "output" else float(start.get(name, default or 0.0)),
                enumeration=enumeration,
            )
        )

    add(
        "load_factor", "input", "Load factor of the turn, lift over weight",
        unit="1", box=validity["load_factor"], default=1.0,
    )  # fmt: skip
    for number, region in enumerate(regions, start=1):
        add(
            f"health.{region}", "input", f"Stiffness that damage region {number} has lost, as a fraction",
            unit="1", display="%", box=validity[region],
        )  # fmt: skip
    add(
        "tip_force", "input", "Upward force at the load point near the tip",
        unit="N", box=validity["tip_force"],
    )  # fmt: skip
    add(
        "young_modulus_factor", "parameter", "Factor on Young's modulus of the skin (e)",
        unit="1", box=validity["young_modulus_factor"], default=1.0,
    )  # fmt: skip
    add("damping.alpha", "parameter", "Mass-proportional Rayleigh damping", unit="1/s", box=(0.0, None))
    add("damping.beta", "parameter", "Stiffness-proportional Rayleigh damping", unit="s", box=(0.0, None))
    add(
        "mass.servo", "parameter", "Mass of each of the two servos",
        unit="kg", display="g", box=validity["servo_mass"],
    )  # fmt: skip
    add(
        "mass.pitot", "parameter", "Mass of the pitot tube at the tip",
        unit="kg", display="g", box=validity["pitot_mass"],
    )  # fmt: skip
    add(
        "initial_tip_displacement", "parameter",
        "Transient only: displacement of the tip from its equilibrium, released at the start",
        unit="m", display="mm", box=(-TIP_DISPLACEMENT_LIMIT, TIP_DISPLACEMENT_LIMIT),
    )  # fmt: skip
    add(
        "response", "parameter", "Quasi-static (1) or transient (2)",
        box=(QUASI_STATIC, TRANSIENT), default=QUASI_STATIC, enumeration="Response",
    )  # fmt: skip
    for gauge in range(1, gauge_count + 1):
        add(
            f"strain[{gauge}]", "output", f"Strain at gauge {gauge}, positive under upward lift",
            unit="1", display="microstrain",
        )  # fmt: skip
    add("tip_displacement", "output", "Displacement of the tip, positive upwards", unit="m", display="mm")
    add(
        "strain_error_bound", "output",
        "Certified bound of the error of any static strain against the full finite element model",
        unit="1", display="microstrain",
    )  # fmt: skip
    add("status", "output", "What became of the last call", enumeration="Status")
    add(
        "load_point_displacement", "output",
        "Displacement of the point near the tip where tip_force acts, positive upwards",
        unit="m", display="mm",
    )  # fmt: skip
    for mode in range(1, mode_count + 1):
        add(f"frequency[{mode}]", "output", f"Natural frequency of mode {mode}", unit="Hz")
    for mode in range(1, mode_count + 1):
        add(
            f"damping_ratio[{mode}]", "output", f"Damping ratio of mode {mode}",
            unit="1", display="%",
        )  # fmt: skip
    return tuple(rows)
