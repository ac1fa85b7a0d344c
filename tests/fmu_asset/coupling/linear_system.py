"""x' = A x + B u, y = C x + D u with two states, inputs and outputs, for pythonfmu's own builder.

Copied to a folder of its own and built there; it is never imported by the tests. The inputs are held over a
step and the states then follow exactly, so that whatever a coupled system gets wrong is the coupling's.
"""

import numpy as np
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real
from scipy.linalg import expm


class LinearSystem(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for name in ("u1", "u2"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in [f"{m}{i}{j}" for m in "abcd" for i in (1, 2) for j in (1, 2)] + ["initial1", "initial2"]:
            setattr(self, name, 0.0)
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )
        for name in ("x1", "x2"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.local))
        for name in ("y1", "y2"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def matrix(self, name):
        return np.array([[getattr(self, f"{name}{i}{j}") for j in (1, 2)] for i in (1, 2)])

    def give(self):
        u = np.array([self.u1, self.u2])
        y = self.matrix("c") @ [self.x1, self.x2] + self.matrix("d") @ u
        self.y1, self.y2 = map(float, y)

    def exit_initialization_mode(self):
        self.x1, self.x2 = self.initial1, self.initial2
        self.give()

    def do_step(self, current_time, step_size):
        block = np.zeros((4, 4))
        block[:2, :2], block[:2, 2:] = self.matrix("a"), self.matrix("b")
        move = expm(block * step_size)[:2] @ [self.x1, self.x2, self.u1, self.u2]
        self.x1, self.x2 = map(float, move)
        self.give()
        return True
