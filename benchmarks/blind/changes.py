"""What can be hidden in a structure, its loads and its instruments, as plain numbers."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from benchmarks.blind.laws import Law


@dataclass(frozen=True)
class Fault:
    """A fault of an instrument.

    Attributes
    ----------
    kind : str
        "gain" (relative), "drift" (amplitude [channel's unit] over the campaign, exponent),
        "rotation" [rad], "thermal" [channel's unit per K], "high_pass" [s], "line" (Hz, cosine,
        sine [channel's unit]), "mode" (Hz, damping ratio, cosine, sine [channel's unit per unit of
        release amplitude]), "offset".
    channels : tuple of str
        Names of the channels.
    numbers : tuple of float
        See `kind`.
    run : str
        "offset": the run whose static trials have it.
    """

    kind: str
    channels: tuple[str, ...]
    numbers: tuple[float, ...]
    run: str = ""


@dataclass(frozen=True)
class Changes:
    """Everything that is hidden in one case; all zero is the nominal structure.

    Attributes
    ----------
    mass, mass_station : float
        A point mass [kg] on the wing's straight chord line at a station [m]; lumped: not used.
    root_compliance : float
        In series with the root's flap spring [rad/(N m)].
    region, loss : int, float
        Damaged region (see `wing_basis`), and the share of the skin's stiffness that it lost.
    modulus_temperature : float
        Relative loss of Young's modulus per kelvin [1/K].
    stiffness_rate : float
        Relative change of stiffness per second in a ring-down [1/s].
    laws : tuple of Law
        Forces inside.
    drag, spread_cubic : float
        Drag [N s^2/m^2] and cubic stiffness [N/m^3] of the whole wing, spread over its area.
    shift_span, shift_chord : float
        Where applied forces really act, from where they are said to [m].
    force_gain, force_tare : float
        Relative error of the load cell, and its tare [N].
    washout, washout_exponent : float
        Lift is (1 - washout n eta^exponent) of itself.
    relief : float
        Share of the weight that relieves the lift beyond what is modelled.
    clock_rate, clock_zero : float
        A sample stamped t was taken at (1 + rate) t + zero [s].
    faults : tuple of Fault
        Of the instruments, in order.
    """

    mass: float = 0.0
    mass_station: float = 0.0
    root_compliance: float = 0.0
    region: int = -1
    loss: float = 0.0
    modulus_temperature: float = 0.0
    stiffness_rate: float = 0.0
    laws: tuple[Law, ...] = ()
    drag: float = 0.0
    spread_cubic: float = 0.0
    shift_span: float = 0.0
    shift_chord: float = 0.0
    force_gain: float = 0.0
    force_tare: float = 0.0
    washout: float = 0.0
    washout_exponent: float = 2.0
    relief: float = 0.0
    clock_rate: float = 0.0
    clock_zero: float = 0.0
    faults: tuple[Fault, ...] = ()

    def with_other(self, other: Changes) -> Changes:
        """Both together; where both set the same number, the other's holds."""
        empty = Changes()
        values: dict[str, Any] = {}
        for attribute in fields(Changes):
            mine, its = getattr(self, attribute.name), getattr(other, attribute.name)
            if isinstance(mine, tuple):
                values[attribute.name] = mine + its
            elif its != getattr(empty, attribute.name):
                values[attribute.name] = its
        return replace(self, **values)

    @property
    def is_linear(self) -> bool:
        """Whether the motion is that of a linear structure that does not change with time."""
        return not (self.laws or self.drag or self.spread_cubic or self.stiffness_rate)
