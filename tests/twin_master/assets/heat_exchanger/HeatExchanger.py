"""A heat exchanger that fouls: an asset that has nothing to do with wings, for pythonfmu's own builder."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class HeatExchanger(Fmi2Slave):
    """Water of 20 C is heated in a tube; fouling takes conductance away."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for causality, starts in (
            ("input", {"mass_flow": 1.0, "fouling": 0.0, "wall_temperature": 80.0}),
            ("parameter", {"conductance": 6000.0, "specific_heat": 4186.0}),
            ("output", {"outlet": 20.0, "middle": 20.0, "heat": 0.0}),
        ):
            kind = Fmi2Variability.tunable if causality == "parameter" else Fmi2Variability.continuous
            for name, start in starts.items():
                setattr(self, name, start)
                self.register_variable(Real(name, causality=Fmi2Causality[causality], variability=kind))

    def do_step(self, current_time, step_size):
        """Set the outputs for the inputs of the step."""
        clean = self.conductance / (1.0 + self.fouling * self.conductance)
        exponent = clean / (self.specific_heat * self.mass_flow)
        rise = self.wall_temperature - 20.0
        self.middle = 20.0 + rise * (1.0 - math.exp(-0.5 * exponent))
        self.outlet = 20.0 + rise * (1.0 - math.exp(-exponent))
        self.heat = self.specific_heat * self.mass_flow * (self.outlet - 20.0)
        return True
