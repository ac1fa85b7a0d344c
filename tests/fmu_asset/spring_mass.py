"""Another asset than the wing, exported by pythonfmu as it comes: a mass on a spring that can misbehave.

Copied to a folder of its own and built there; it is never imported by the tests.
"""

import builtins
import ctypes
import json
import math
import os
import time

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real

FINE, NOT_A_NUMBER, SLEEP, DIE, RAISE, DISCARD, WANDER, TALK, LOOP = range(9)
HOLD, SPOIL_JSON, SPOIL_BUILTINS, ESCAPES, READ = range(9, 14)


class SpringMass(Fmi2Slave):
    description = "A mass on a spring"

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.force = 0.0
        self.stiffness = 4.0
        self.locked = False
        self.misbehaviour = FINE
        self.position = 0.0
        self.velocity = 0.0
        self.steps = 0
        for name in ("force", "stiffness"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(
            Boolean("locked", causality=Fmi2Causality.input, variability=Fmi2Variability.discrete)
        )
        self.register_variable(
            Integer("misbehaviour", causality=Fmi2Causality.input, variability=Fmi2Variability.discrete)
        )
        for name in ("position", "velocity"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        self.register_variable(
            Integer("steps", causality=Fmi2Causality.output, variability=Fmi2Variability.discrete)
        )

    def do_step(self, current_time, step_size):
        if self.misbehaviour == NOT_A_NUMBER:
            self.position = math.nan
        elif self.misbehaviour == SLEEP:
            time.sleep(60.0)
        elif self.misbehaviour == LOOP:
            while True:
                pass
        elif self.misbehaviour == HOLD:
            ctypes.PyDLL(None).sleep(600)  # a PyDLL keeps the lock of the interpreter
        elif self.misbehaviour == SPOIL_JSON:
            json.JSONEncoder.encode = json.dumps = lambda *_, **__: "spoilt"
            raise ArithmeticError("the spring broke")
        elif self.misbehaviour == SPOIL_BUILTINS:
            builtins.len = lambda _: 3
        elif self.misbehaviour == ESCAPES:
            self.log("\x1b[2J\x1b]0;owned\x07 the spring \x9b31mcreaks")
            raise ArithmeticError("\x1b[31mthe spring broke")
        elif self.misbehaviour == READ:
            with open(os.environ["HOSTILE_TARGET"]) as file:  # noqa: PTH123
                file.read()
        elif self.misbehaviour == DIE:
            os.abort()
        elif self.misbehaviour == RAISE:
            raise ArithmeticError("the spring broke")
        elif self.misbehaviour == DISCARD:
            return False
        elif self.misbehaviour == WANDER:
            os.chdir("/")
        elif self.misbehaviour == TALK:
            print("chatter " * 100_000, flush=True)  # noqa: T201
            self.log("the spring creaks")
        if not self.locked and self.misbehaviour != NOT_A_NUMBER:
            for _ in range(100):
                self.velocity += (self.force - self.stiffness * self.position) * step_size / 100
                self.position += self.velocity * step_size / 100
        self.steps += 1
        return True
