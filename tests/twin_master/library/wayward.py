"""An FMU for the sampling tests: a lever with a gain that wears, and that can misbehave on request."""

import os
import time
from typing import ClassVar

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

FINE, LAG, COUNT, DIE, SLEEP, REFUSE, SLOW = range(7)


class Wayward(Fmi2Slave):
    unit_table: ClassVar = {"N": {"kg": 1, "m": 1, "s": -2}, "1": {}, "m": {"m": 1}}
    variable_table: ClassVar = {
        "push": ("input", "N", 0.0, 10.0, 0.0, ""),
        "wear": ("input", "1", 0.0, 1.0, 0.0, ""),
        "mode": ("input", "1", 0.0, 6.0, 0.0, ""),
        "gain": ("parameter", "1", None, None, 1.0, ""),
        "shown": ("output", "m", None, None, None, ""),
        "double": ("output", "m", None, None, None, ""),
    }

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.count = 0
        for name, (causality, _, _, _, start, _) in self.variable_table.items():
            setattr(self, name, start or 0.0)
            kind = Fmi2Variability.fixed if causality == "parameter" else Fmi2Variability.continuous
            self.register_variable(Real(name, causality=Fmi2Causality[causality], variability=kind))

    def do_step(self, current_time, step_size):
        target = self.gain * self.push / (1.0 + self.wear)
        self.count += 1
        if self.mode == LAG:
            self.shown += 0.5 * (target - self.shown)
        elif self.mode == COUNT:
            self.shown = target + 1e-3 * self.count
        else:
            self.shown = target
        if self.mode == DIE and self.wear > 0.4:
            print("the lever snaps", flush=True)  # noqa: T201
            os.abort()
        if self.mode == SLEEP:
            time.sleep(60.0)
        if self.mode == SLOW:
            time.sleep(0.005)
        self.double = 2.0 * self.shown
        return not (self.mode == REFUSE and self.wear > 0.4)
