"""A heat exchanger that fouls: an asset that has nothing to do with wings, for pythonfmu's own builder."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class HeatExchanger(Fmi2Slave):
    """Water of 20 C is heated in a tube; fouling takes conductance away."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.mass_flow = 1.0
        self.fouling = 0.0
        self.wall_temperature = 80.0
        self.conductance = 6000.0
        self.specific_heat = 4186.0
        self.outlet = 20.0
        self.middle = 20.0
        self.heat = 0.0
        for name in ("mass_flow", "fouling", "wall_temperature"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("conductance", "specific_heat"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )
        for name in ("outlet", "middle", "heat"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        """Set the outputs for the inputs of the step."""
        clean = self.conductance / (1.0 + self.fouling * self.conductance)
        exponent = clean / (self.specific_heat * self.mass_flow)
        rise = self.wall_temperature - 20.0
        self.middle = 20.0 + rise * (1.0 - math.exp(-0.5 * exponent))
        self.outlet = 20.0 + rise * (1.0 - math.exp(-exponent))
        self.heat = self.specific_heat * self.mass_flow * (self.outlet - 20.0)
        return True
