"""What tests of models ask: trials, what a model shows of them, and a general integrator of the same."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.models.interface import Conditions, Model
from fe.runtime.patch import ModelPatch, Primitive

FloatArray = NDArray[np.float64]
Outputs = dict[str, Quantity] | tuple[tuple[str, Quantity], ...]


def trial(kind: TrialKind, time: Any, **said: Any) -> Trial:
    """Return a trial at times [s], or of so many samples each 10 ms."""
    stamps = 0.01 * np.arange(time) if isinstance(time, int) else np.asarray(time, dtype=np.float64)
    return Trial.plain("a trial", kind, said.pop("channels", ()), stamps, **said)


def seen(model: Model, what: Trial, outputs: Outputs, *items: Primitive, **given: Any) -> FloatArray:
    """Return what a model with a patch shows; further conditions by name, the parameters one by default."""
    conditions = Conditions(**{"parameters": np.ones(len(model.parameters)), **given})
    asked = tuple(outputs.items()) if isinstance(outputs, dict) else outputs
    return model.respond(what, asked, ModelPatch(items), conditions).values


def campaign(*trials: Trial, temperature: float | None = None, **channels: Any) -> Campaign:
    return Campaign("c", channels, trials, temperature, {}, "")


def integrated(rate: Any, time: FloatArray, first: Any, parts: bool = False, **options: Any) -> FloatArray:
    """Return states (N, n) at stamps; with `parts` the rate is also told the number of the interval."""
    limits = {"rtol": 1e-10, "atol": 1e-12} | options
    if not parts:
        return np.asarray(solve_ivp(rate, (time[0], time[-1]), first, t_eval=time, **limits).y.T)
    states = [np.asarray(first, dtype=np.float64)]
    for k in range(len(time) - 1):
        moved = solve_ivp(rate, (time[k], time[k + 1]), states[-1], args=(k,), **limits)
        states.append(moved.y[:, -1])
    return np.array(states)
