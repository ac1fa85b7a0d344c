"""Independent answers for tests of inference: enumeration, arbitrary precision, variable elimination."""

import logging
import warnings
from decimal import Decimal, localcontext

import numpy as np

from twin_master.network.graphical_model import Factor, GraphicalModel, StateSpace
from twin_master.network.transition import TransitionModel


def random_model(rng, shape=(2, 2), zeros=0.4, product=False):
    """A model with random dense-with-holes transitions under two controls: a table of all states, or one
    for each factor."""
    size, tables = int(np.prod(shape)), []
    for count in shape if product else (size,):
        table = rng.dirichlet(np.ones(count), (2, count))
        table[rng.random(table.shape) < zeros] = 0.0
        table[:, np.arange(count), rng.integers(count, size=count)] += 0.1
        tables.append(table / table.sum(axis=2, keepdims=True))
    prior = rng.dirichlet(np.ones(size))
    prior[rng.random(size) < zeros] = 0.0
    prior[rng.integers(size)] += 0.1
    space = StateSpace(tuple(Factor(f"f{i}", tuple(map(float, range(n)))) for i, n in enumerate(shape)))
    return GraphicalModel(space, ("u0", "u1"), prior / prior.sum(), TransitionModel(tuple(tables)))


def trajectories(model, control, log_likelihood):
    """Yield, for each step, p(path) without and with what it shows: tables (S, ..., S) of every path."""
    joint = np.ones(())
    for t, row in enumerate(log_likelihood):
        joint = joint[..., None] * (model.transition.matrix[control[t - 1]] if t else model.prior)
        before, joint = joint, joint * np.exp(row)
        yield before, joint


def enumerate_trajectories(model, control, log_likelihood):
    """Filtered, smoothed and log evidence by summing over every joint trajectory."""
    tables = [*trajectories(model, control, log_likelihood)]
    forecast, filtered = (
        np.array([table.sum(axis=tuple(range(t))) for t, table in enumerate(some)])
        for some in zip(*tables, strict=True)
    )
    steps = range(len(tables))
    smoothed = np.array([tables[-1][1].sum(axis=tuple({*steps} - {t})) for t in steps])
    evidence = filtered.sum(axis=1)
    forecast /= forecast.sum(axis=1, keepdims=True)
    log_evidence = np.diff(np.log(evidence), prepend=0.0)
    return forecast, filtered / evidence[:, None], smoothed / evidence[-1], log_evidence


def precise_forward_backward(model, control, log_likelihood, digits=40):
    """Forecast, filtered and smoothed beliefs, log filtered and log evidence, with an unbounded exponent."""

    def decimals(values, of=lambda x: Decimal(float(x))):
        return np.vectorize(of, otypes=[object])(values)

    with localcontext() as context:
        context.prec, context.Emax, context.Emin = digits, 10**17, -(10**17)
        matrix, belief = decimals(model.transition.matrix), decimals(model.prior)
        likelihood = decimals(
            log_likelihood, lambda x: Decimal(float(x)).exp() if np.isfinite(x) else Decimal(0)
        )
        forecast, filtered, evidence = [], [], []
        for t, row in enumerate(likelihood):
            forecast.append(belief @ matrix[control[t - 1]] if t else belief)
            belief = forecast[-1] * row
            evidence.append(belief.sum())
            belief = belief / evidence[-1]
            filtered.append(belief)
        message, smoothed = decimals(np.ones(len(belief))), [filtered[-1]]
        for t in range(len(filtered) - 2, -1, -1):
            message = matrix[control[t]] @ (message * likelihood[t + 1])
            message = message / message.sum()
            joint = filtered[t] * message
            smoothed.insert(0, joint / joint.sum())
        log_filtered = [[float(x.ln()) if x else -np.inf for x in row] for row in filtered]
        log_evidence = [float(x.ln()) for x in evidence]
    beliefs = (np.array(values, float) for values in (forecast, filtered, smoothed))
    return *beliefs, np.array(log_filtered), np.array(log_evidence)


def eliminate_variables(model, control, log_likelihood, policy, horizon):
    """Smoothed beliefs (T, S), and joint predictions of state and control (H, S, U), by pgmpy.

    An observation is a child of the state that is seen with the likelihood's odds.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("pgmpy").setLevel(logging.ERROR)
        from pgmpy.factors.discrete import TabularCPD
        from pgmpy.inference import VariableElimination
        from pgmpy.models import DiscreteBayesianNetwork

        steps, size = log_likelihood.shape
        matrix, controls = model.transition.matrix, len(model.controls)
        tables = [TabularCPD("D0", size, model.prior[:, None])]
        for t in range(1, steps + 1):
            tables.append(TabularCPD(f"D{t}", size, matrix[control[t - 1]].T, [f"D{t - 1}"], [size]))
        for t in range(steps, steps + horizon):
            tables.append(TabularCPD(f"U{t}", controls, policy.T, [f"D{t}"], [size]))
            if t > steps:
                flat = matrix.transpose(2, 1, 0).reshape(size, size * controls)
                tables.append(TabularCPD(f"D{t}", size, flat, [f"D{t - 1}", f"U{t - 1}"], [size, controls]))
        for t in range(steps):
            odds = np.exp(log_likelihood[t] - log_likelihood[t].max())
            tables.append(TabularCPD(f"O{t}", 2, np.stack([1 - odds, odds]), [f"D{t}"], [size]))
        network = DiscreteBayesianNetwork(
            [(parent, table.variable) for table in tables for parent in table.variables[1:]]
        )
        network.add_cpds(*tables)
        inference, evidence = VariableElimination(network), {f"O{t}": 1 for t in range(steps)}

        def query(*names):
            found = inference.query([*names], evidence=evidence, show_progress=False)
            return np.moveaxis(
                found.values, [found.variables.index(name) for name in names], range(len(names))
            )

        smoothed = np.array([query(f"D{t}") for t in range(steps)])
        return smoothed, np.array([query(f"D{t}", f"U{t}") for t in range(steps, steps + horizon)])
