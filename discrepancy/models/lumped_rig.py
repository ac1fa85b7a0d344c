"""A lumped model at values of its parameters: its matrices, and the systems that they make."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import eigh

from discrepancy.campaign.records import FloatArray
from discrepancy.models.lumped_controllers import loops
from discrepancy.models.lumped_file import KINDS, OF_STATES, LumpedDescription
from discrepancy.models.memory import Memory
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.patch import PointMass, Primitive, RootCompliance

MOST_MODES = 8
"""Modes that move of a structure on springs; the others follow without inertia."""


class LumpedRig:
    """A lumped model's description with the factors of its parameters.

    Parameters
    ----------
    description : LumpedDescription
        Content of the file.
    factors : mapping of str to float
        Of terms, by name.
    structure : sequence of Primitive
        What a patch changes of the structure.
    softening : float
        Share of the stiffness that the temperature takes.
    """

    def __init__(
        self,
        description: LumpedDescription,
        factors: Mapping[str, float],
        structure: Sequence[Primitive] = (),
        softening: float = 0.0,
    ) -> None:
        self.description, self.factors = description, factors
        self._inputs = {item.name: np.array(item.vector) for item in description.input}
        self.loops = loops(description, factors)
        self.width, self.padded = description.width, description.padded
        softened = {**factors, "stiffness": factors.get("stiffness", 1.0) * (1.0 - softening)}
        whole = {kind: description.whole(kind, softened) for kind in KINDS if kind != "damping"}
        for change in structure:
            self._change(change, whole["mass"], whole["stiffness"])
        whole["damping"] = self._damping(whole["mass"], whole["stiffness"])
        self._terms = {
            part.name: self._placed(kind, factors.get(part.name, 1.0) * np.array(part.matrix))
            for kind in KINDS
            for part in description.parts(kind)
        }
        self._terms |= {kind: self._placed(kind, matrix) for kind, matrix in whole.items()}
        self._systems = Memory()
        self.constant = sum(
            (self.along(item.vector, item.through, item.name) for item in description.load),
            np.zeros(self.width),
        )

    def _placed(self, kind: str, matrix: FloatArray) -> FloatArray:
        """Return a matrix of a kind among all unknowns (N, N)."""
        first = self.description.size if kind in OF_STATES else 0
        whole, at = np.zeros((self.width, self.width)), slice(first, first + len(matrix))
        whole[at, at] = matrix
        return whole

    def _change(self, change: Primitive, mass: FloatArray, stiffness: FloatArray) -> None:
        """Put a point mass or a compliance of the root into the matrices."""
        if isinstance(change, PointMass):
            places = sorted(self.description.place, key=lambda place: place.station)
            stations = [place.station for place in places]
            columns = zip(*(place.vector for place in places), strict=True)
            row = np.array([np.interp(change.station, stations, column) for column in columns])
            mass += change.mass * np.outer(row, row)
        elif isinstance(change, RootCompliance) and self.description.root is not None:
            # in series: K^-1 + c l l^T, by Sherman and Morrison
            pull = stiffness @ np.array(self.description.root.lever)
            stiff = float(pull @ np.array(self.description.root.lever))
            stiffness -= np.outer(pull, pull) * change.compliance / (1.0 + change.compliance * stiff)

    def _damping(self, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
        given, factor = self.description.damping, self.factors.get("damping", 1.0)
        if given is None or not len(mass):
            matrix = np.zeros_like(mass)
        elif given.matrix is not None:
            matrix = np.array(given.matrix)
        elif given.ratios is not None:
            square, shapes = eigh(stiffness, mass)
            weighted, w = mass @ shapes, np.sqrt(np.maximum(square, 0.0))
            twice = 2.0 * np.array(given.ratios) * w
            matrix = (weighted * twice) @ weighted.T
        else:
            matrix = (given.alpha or 0.0) * mass + (given.beta or 0.0) * stiffness
        for part in self.description.parts("damping"):
            matrix = matrix + self.factors.get(part.name, 1.0) * np.array(part.matrix)
        return np.asarray(factor * matrix)

    def along(self, vector: Sequence[float] | FloatArray, through: str | None, name: str) -> FloatArray:
        """Return the vector (N,) of a load, through a matrix where it says so, times its own factor."""
        row = self.padded(vector) if through is None else self._terms[through] @ self.padded(vector)
        return np.asarray(self.factors.get(name, 1.0) * row)

    def system(self, drives: tuple[str, ...] = (), *, closed: bool = True) -> SecondOrderSystem:
        """Return the system with the motions of some inputs prescribed, with its controllers or without."""
        return self._systems.get((drives, closed), lambda: self._made(drives, closed=closed))

    def _made(self, drives: tuple[str, ...], *, closed: bool) -> SecondOrderSystem:
        description, n, m = self.description, self.description.size, self.description.states
        own, terms = slice(n, n + m), self._terms
        mass, damping = terms["mass"] + terms["capacity"], terms["damping"] + terms["conductance"]
        mass[n + m :, n + m :], stiffness = np.eye(self.width - n - m), terms["stiffness"].copy()
        coupling = description.coupling
        for content, into, rows, columns in (
            (coupling.force_of_states, damping, slice(0, n), own),
            (coupling.flow_of_speeds, damping, own, slice(0, n)),
            (coupling.flow_of_displacements, stiffness, own, slice(0, n)),
        ):
            if content is not None:
                into[rows, columns] = -np.array(content)
        for loop in self.loops if closed else ():
            loop.close(damping, stiffness)
        beta = description.damping.beta if description.damping is not None else None
        return SecondOrderSystem(
            mass, damping, stiffness,
            {item.name: self.padded(item.vector) for item in description.port},
            mode_count=MOST_MODES if description.is_plain else None,
            relaxation=self.factors.get("damping", 1.0) * (beta or 0.0),
            states=self.width - n,
            drives=np.array([self.padded(self._inputs[name]) for name in drives]),
            actions={item.name: self.padded(item.acts) for item in description.port if item.acts is not None},
        )  # fmt: skip
