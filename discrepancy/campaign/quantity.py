"""Quantities of channels and inputs, and which of them are derivatives of one another."""

from enum import StrEnum


class Quantity(StrEnum):
    """What a channel or an input is; the unit of its values here is that of `units.UNITS`."""

    STRAIN = "strain"
    DISPLACEMENT = "displacement"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    SIGNAL = "signal"  # uncalibrated, e.g. V: the channel's gain is unknown and fitted
    ANGLE = "angle"
    ANGULAR_VELOCITY = "angular_velocity"
    ANGULAR_ACCELERATION = "angular_acceleration"
    FORCE = "force"
    TORQUE = "torque"
    PRESSURE = "pressure"
    LEVEL = "level"
    FLOW = "flow"
    TEMPERATURE = "temperature"
    HEAT = "heat"
    VOLTAGE = "voltage"
    CURRENT = "current"
    CHARGE = "charge"

    @property
    def moving(self) -> "tuple[Quantity, ...]":
        """The quantity, if it is of a motion, among those that follow one another by derivation."""
        return next((family for family in _MOVING if self in family), ())

    @property
    def order(self) -> int:
        """How often a displacement is derived to be this; if it is, it is nought at rest."""
        return _ORDERS.get(self, 0)

    def derivatives_of(self, output: "Quantity") -> int:
        """Return how often an output of a model is derived in time for a channel of this quantity."""
        return max(self.order - output.order, 0) if output in self.moving else 0

    def shows(self, output: "Quantity") -> bool:
        """Whether a channel of this quantity can measure what an output of a model is."""
        return self is output or self is Quantity.SIGNAL or self.derivatives_of(output) > 0


_MOVING = (
    (Quantity.DISPLACEMENT, Quantity.VELOCITY, Quantity.ACCELERATION),
    (Quantity.ANGLE, Quantity.ANGULAR_VELOCITY, Quantity.ANGULAR_ACCELERATION),
)
_ORDERS = {quantity: order for family in _MOVING for order, quantity in enumerate(family)}
