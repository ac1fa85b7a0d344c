"""A mass on a spring that can misbehave, exported by pythonfmu as it comes.

Copied to a folder of its own and built there; it is never imported by the tests.
"""

import builtins
import ctypes
import itertools
import json
import math
import os
import time

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


def broken(_, text="the spring broke"):
    raise ArithmeticError(text)


def spoil_json(mass):
    json.JSONEncoder.encode = json.dumps = lambda *_, **__: "spoilt"
    broken(mass)


def talk(mass):
    print("chatter " * 100_000, flush=True)  # noqa: T201
    mass.log("the spring creaks")


def escape(mass):
    mass.log("\x1b[2J\x1b]0;owned\x07 the spring \x9b31mcreaks")
    broken(mass, "\x1b[31mthe spring broke")


def read(_):
    with open(os.environ["HOSTILE_TARGET"], encoding="utf-8") as file:  # noqa: PTH123
        file.read()


DEEDS = (
    lambda _: None,
    lambda mass: setattr(mass, "position", math.nan),
    lambda _: time.sleep(60.0),
    lambda _: os.abort(),
    broken,
    lambda _: False,
    lambda _: os.chdir("/"),
    talk,
    lambda _: all(itertools.repeat(1)),
    lambda _: ctypes.PyDLL(None).sleep(600),  # a PyDLL keeps the lock of the interpreter
    spoil_json,
    lambda _: setattr(builtins, "len", lambda _: 3),
    escape,
    read,
)
"""What it does by the number of its misbehaviour, before it moves; False refuses the step."""


VARIABLES = {
    "force": (Real, "input", 0.0),
    "stiffness": (Real, "input", 4.0),
    "locked": (Boolean, "input", False),
    "misbehaviour": (Integer, "input", 0),
    "position": (Real, "output", 0.0),
    "velocity": (Real, "output", 0.0),
    "steps": (Integer, "output", 0),
}


class SpringMass(Fmi2Slave):
    description = "A mass on a spring"

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for name, (kind, causality, start) in VARIABLES.items():
            setattr(self, name, start)
            varies = "continuous" if kind is Real else "discrete"
            told = {"causality": Fmi2Causality[causality], "variability": Fmi2Variability[varies]}
            self.register_variable(kind(name, **told))

    def do_step(self, current_time, step_size):
        if DEEDS[self.misbehaviour](self) is False:
            return False
        for _ in range(0 if self.locked or math.isnan(self.position) else 100):
            self.velocity += (self.force - self.stiffness * self.position) * step_size / 100
            self.position += self.velocity * step_size / 100
        self.steps += 1
        return True
