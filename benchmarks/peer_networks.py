"""The network of the twin solved by other programs: pgmpy, pymdptoolbox and dynamax."""

import logging
import os
import subprocess
import sys
import tempfile
import time
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.measurement import NotAvailableError
from twin_master.network.graphical_model import GraphicalModel

Float = NDArray[np.float64]

REPEATS = 3
PEER_PYTHON = "UAV_TWIN_PEER_PYTHON"
"""The environment variable that names a Python interpreter in whose environment dynamax is."""


class NetworkBeliefs(NamedTuple):
    """Beliefs by another program, and the time that it took.

    Attributes
    ----------
    seconds : float
        The least time of several [s].
    beliefs : (T + H, S) ndarray
        The smoothed beliefs of T steps and the predicted ones of H steps.
    """

    seconds: float
    beliefs: Float


class PlannedValue(NamedTuple):
    """A plan by another program.

    Attributes
    ----------
    seconds : float
        The least time of several [s].
    value : (S,) ndarray
        The value of each state.
    """

    seconds: float
    value: Float


class SmoothedBatch(NamedTuple):
    """The posterior of many sequences by another program.

    Attributes
    ----------
    peer : str
        The program with its version.
    seconds : float
        The least processor time of several, without compilation [s].
    smoothed : (B, T, S) ndarray
        The smoothed beliefs.
    """

    peer: str
    seconds: float
    smoothed: Float


def eliminate_variables(
    model: GraphicalModel,
    control: NDArray[np.int64],
    log_likelihood: Float,
    policy: Float,
    horizon: int,
) -> NetworkBeliefs:
    """Return the beliefs that pgmpy finds by variable elimination.

    The network has a node D for the state of each step, a node O for the observation of each of the
    first T steps, and a node U for the control of each predicted step. Observations are binary
    evidence whose probabilities are in the ratio of the likelihoods.

    Parameters
    ----------
    model : GraphicalModel
        The S states, prior and transitions.
    control : (T,) array of int
        The control of each observed step.
    log_likelihood : (T, S) array
        The log likelihood of each state.
    policy : (S, U) array
        The probability of each control in the predicted steps.
    horizon : int
        The number H of predicted steps.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("pgmpy").setLevel(logging.ERROR)
        from pgmpy.factors.discrete import TabularCPD
        from pgmpy.inference import VariableElimination
        from pgmpy.models import DiscreteBayesianNetwork

        steps, size = log_likelihood.shape
        matrix = model.transition.matrix
        controls = len(matrix)
        tables = [TabularCPD("D0", size, model.prior[:, None])]
        for t in range(1, steps + horizon):
            if t <= steps:
                move = matrix[control[t - 1]].T
                tables.append(TabularCPD(f"D{t}", size, move, [f"D{t - 1}"], [size]))
            else:
                moves = matrix.transpose(2, 1, 0).reshape(size, -1)
                parents = [f"D{t - 1}", f"U{t - 1}"]
                tables.append(TabularCPD(f"D{t}", size, moves, parents, [size, controls]))
            if t >= steps:
                tables.append(TabularCPD(f"U{t}", controls, policy.T, [f"D{t}"], [size]))
        for t in range(steps):
            odds = np.exp(log_likelihood[t] - log_likelihood[t].max())
            tables.append(TabularCPD(f"O{t}", 2, np.stack([1.0 - odds, odds]), [f"D{t}"], [size]))
        network = DiscreteBayesianNetwork(
            [(parent, table.variable) for table in tables for parent in table.variables[1:]]
        )
        network.add_cpds(*tables)
        inference = VariableElimination(network)
        evidence = {f"O{t}": 1 for t in range(steps)}

        def query_all() -> Float:
            beliefs = [
                inference.query([f"D{t}"], evidence=evidence, show_progress=False).values
                for t in range(steps + horizon)
            ]
            return np.array(beliefs)

        beliefs = query_all()
        times = []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            query_all()
            times.append(time.perf_counter() - begin)
    return NetworkBeliefs(min(times), beliefs)


def plan_by_toolbox(model: GraphicalModel, reward: Float, discount: float) -> PlannedValue:
    """Return the plan of pymdptoolbox by value iteration, for a reward (S, U)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mdptoolbox.mdp import ValueIteration

        transition = np.array(model.transition.matrix)
        times = []
        for _ in range(5 * REPEATS):
            begin = time.perf_counter()
            plan = ValueIteration(transition, reward, discount, epsilon=1e-12, max_iter=1000)
            plan.run()
            times.append(time.perf_counter() - begin)
    return PlannedValue(min(times), np.array(plan.V))


def python_with_dynamax() -> str:
    """Return the Python interpreter that has dynamax: this one, or that of `UAV_TWIN_PEER_PYTHON`.

    Raises
    ------
    NotAvailableError
        If neither has it.
    """
    if find_spec("dynamax") is not None:
        return sys.executable
    other = os.environ.get(PEER_PYTHON)
    if other:
        return other
    raise NotAvailableError(
        "dynamax is not installed: `python3 -m venv peers && peers/bin/pip install dynamax`, then "
        "`python -m benchmarks --peer-python peers/bin/python`"
    )


def smooth_by_dynamax(
    model: GraphicalModel, control: NDArray[np.int64], log_likelihoods: Float
) -> SmoothedBatch:
    """Return the beliefs that the smoother of dynamax finds, in a process of its own on one core.

    Parameters
    ----------
    model : GraphicalModel
        The S states, prior and transitions.
    control : (T,) array of int
        The control of each step, the same for all sequences.
    log_likelihoods : (B, T, S) array
        The log likelihood of each state in each step of B sequences.

    Raises
    ------
    NotAvailableError
        If dynamax is not installed.
    RuntimeError
        If the process fails.
    """
    python = python_with_dynamax()
    script = Path(__file__).with_name("dynamax_smoother.py")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        np.savez(
            folder / "problem.npz",
            prior=model.prior,
            transitions=np.array(model.transition.matrix)[control[:-1]],
            log_likelihoods=log_likelihoods,
        )
        finished = subprocess.run(
            [python, str(script), str(folder / "problem.npz"), str(folder / "posterior.npz")],
            env=os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            check=False,
        )
        if finished.returncode:
            errors = [line for line in finished.stderr.splitlines() if "Error" in line]
            reason = errors[-1] if errors else f"exit code {finished.returncode}"
            raise RuntimeError(f"dynamax in the environment of {python} failed: {reason}")
        with np.load(folder / "posterior.npz") as posterior:
            return SmoothedBatch(
                peer=str(posterior["peer"]),
                seconds=float(posterior["seconds"]),
                smoothed=posterior["smoothed"],
            )
