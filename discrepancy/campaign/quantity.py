"""Quantities of channels and inputs, and which of them are derivatives of one another."""

from enum import StrEnum


class Quantity(StrEnum):
    """The physical quantity of a channel or an input; `units.UNITS` has the units of each."""

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
    def motion_chain(self) -> "tuple[Quantity, ...]":
        """A quantity of motion with its time derivatives, from displacement to acceleration.

        Empty for a quantity that is not one of motion.
        """
        return next((family for family in _MOTIONS if self in family), ())

    @property
    def order(self) -> int:
        """Order of the time derivative of a displacement or an angle: 1 for a velocity."""
        return _ORDERS.get(self, 0)

    def derivatives_of(self, output: "Quantity") -> int:
        """Return how often a model's output is differentiated in time to give this quantity."""
        return max(self.order - output.order, 0) if output in self.motion_chain else 0

    def can_measure(self, output: "Quantity") -> bool:
        """Return whether a channel of this quantity can measure an output of another quantity."""
        return self is output or self is Quantity.SIGNAL or self.derivatives_of(output) > 0


_MOTIONS = (
    (Quantity.DISPLACEMENT, Quantity.VELOCITY, Quantity.ACCELERATION),
    (Quantity.ANGLE, Quantity.ANGULAR_VELOCITY, Quantity.ANGULAR_ACCELERATION),
)
_ORDERS = {quantity: order for family in _MOTIONS for order, quantity in enumerate(family)}
