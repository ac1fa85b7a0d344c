"""`CoupledAsset`: several FMUs flown as one `FmiAsset`."""

import math
from typing import Any, Literal, cast

from fmu_asset.door.binding import Binding
from fmu_asset.door.exchange import Exchange, Values
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import AlgebraicLoopError, BindingError, CouplingError, said

from .instance import CoupledFmus, naming
from .structure import SystemStructure
from .system import parts_of, system_description, wiring_hash
from .wiring import Schedule, Wiring, loop_sentence

Algorithm = Literal["gauss_seidel", "jacobi"]
ALGORITHMS: tuple[Algorithm, ...] = ("gauss_seidel", "jacobi")


class CoupledAsset(FmiAsset):
    """Several FMUs that are flown step by step as one asset, through a binding.

    The step size of the binding is that of the system: outputs are exchanged once a step. With
    ``"gauss_seidel"`` each component takes the newest outputs of those that were stepped before it, in the
    order of `schedule`; with ``"jacobi"`` all take the outputs of the beginning of the step. With more than
    one iteration, components that are connected in a circle repeat the step until what they exchange has
    settled.

    After a step that failed, the components no longer stand at the same time: reset the asset or restore a
    state of it. Where an FMU ends its simulation, `simulate` ends with the step before.

    Parameters
    ----------
    structure : SystemStructure or Wiring
        The system.
    binding : Binding
        Its variables are connectors of the system, or `component.variable`.
    algorithm : {"gauss_seidel", "jacobi"}
        How values are passed on within a step.
    iterations : int
        Largest number of times that a step of a circle of components is made.
    tolerance : float
        A circle has settled when no value exchanged in it changes by more than this times the larger of one
        and its magnitude.
    isolated : bool
        Whether each FMU runs in a worker process of its own.
    step_timeout : float, optional
        Wall-clock limit of one step of one FMU [s], instead of the binding's.
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units.

    Raises
    ------
    CouplingError
        If the system cannot be joined.
    AlgebraicLoopError
        If it has an algebraic loop, and the algorithm is Gauss-Seidel without iterations.
    BindingError
        If the binding does not fit.
    FmuFileError, FmuUnsupportedError
        If an FMU cannot be used.
    """

    def __init__(
        self,
        structure: SystemStructure | Wiring,
        binding: Binding,
        *,
        algorithm: Algorithm = "gauss_seidel",
        iterations: int = 1,
        tolerance: float = 1e-9,
        isolated: bool = True,
        step_timeout: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        if algorithm not in ALGORITHMS:
            raise CouplingError(said("coupling.algorithm", known=ALGORITHMS, algorithm=algorithm))
        if iterations < 1 or not (tolerance > 0.0 and math.isfinite(tolerance)):
            raise CouplingError(said("coupling.iterations", iterations=iterations, tolerance=tolerance))
        self._wiring = wiring = structure if isinstance(structure, Wiring) else Wiring(structure)
        if binding.binding.decimation != 1:
            raise BindingError(said("coupling.decimation", binding=binding))
        jacobi, plan = algorithm == "jacobi", wiring.schedule
        if plan.loops and iterations == 1 and not jacobi:  # Jacobi delays every connection
            raise AlgebraicLoopError(loop_sentence(plan.loops))
        system = system_description(wiring, wiring_hash(wiring, binding, algorithm, iterations, tolerance))
        # Lines are drawn at the components.
        exchange = Exchange(system, binding.with_header(interpolation="zero-order"))
        parts = parts_of(wiring, exchange, linear=binding.binding.interpolation == "linear")
        tuned = system.of_components(exchange.settings(parameters or {}))
        assets = {}
        for name, part in parts.items():
            with naming(name):
                assets[name] = FmiAsset(
                    wiring.declared[name].path,
                    part.binding,
                    isolated=isolated,
                    step_timeout=step_timeout,
                    parameters=part.settings | tuned.get(name, {}),
                )
        for name in (name for group in plan.circles if iterations > 1 for name in group):
            if assets[name].state_method != "serialised":
                raise CouplingError(said("coupling.no_state", name=name))
        housing = CoupledFmus(
            exchange, plan, parts, assets, jacobi=jacobi, iterations=iterations, tolerance=tolerance
        )
        self._parts = parts
        self._settle(exchange, housing, parameters or {})

    @property
    def schedule(self) -> Schedule:
        """Order of the components."""
        return self._wiring.schedule

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMUs: status, and component with text."""
        return tuple(
            (status, f"{name}: {text}")
            for name, asset in cast("CoupledFmus", self._housing).assets.items()
            for status, text in asset.log
        )

    def describe(self) -> dict[str, Any]:
        """Return the system as plain records for a listing."""
        plan = self.schedule
        return {
            "system": self._wiring.structure.name,
            "components": {c.name: str(c.fmu) for c in self._wiring.structure.components},
            "order": list(plan.order),
            "linear": [name for name, part in self._parts.items() if part.linear],
            "held": [f"{link.source} -> {link.target}" for link in plan.held],
            "loops": [" -> ".join(str(end) for end in loop) for loop in plan.loops],
            "binding": self.binding.name,
            "step_size": self._interval,
        }
