"""Run CalculiX on variants of a deck, and cite the line of the deck if it fails."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError
from fe.structure.abaqus import KeywordBlock
from fe.structure.matrix_tables import Dof, read_matrix, read_unknowns
from fe.verification.calculix_run import first_error, read_frequencies, read_tables, run_calculix

from .linear_model import LinearModel, block_lines, set_block
from .loads import DeckLoad

ALL_NODES = "UAVALL"
"""Name of the set of all nodes, whose displacements are printed."""
_STORE_MATRICES = ("*FREQUENCY, SOLVER=MATRIXSTORAGE",)


@dataclass(frozen=True)
class StoredMatrices:
    """Matrices that CalculiX has written, with n rows, in the units of the deck.

    Attributes
    ----------
    stiffness, mass : sparse (n, n) array
        The matrices.
    dofs : list of Dof
        Node and direction of each row. Nodes that CalculiX made have numbers beyond the deck's.
    """

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    dofs: list[Dof]


@dataclass(frozen=True)
class CalculixJobs:
    """Runs of CalculiX on variants of a deck.

    Attributes
    ----------
    time_limit : float
        Longest time of one run [s].
    """

    model: LinearModel
    folder: Path
    time_limit: float

    def matrices(
        self,
        name: str,
        blocks: Sequence[KeywordBlock],
        *,
        free: bool = False,
        preloaded: bool = False,
        step_lines: Sequence[str] = (),
    ) -> StoredMatrices:
        """Let CalculiX store the matrices of the model with given blocks.

        Parameters
        ----------
        free, preloaded : bool
            As in `LinearModel.text`.
        step_lines : sequence of str
            Further lines of the step.

        Raises
        ------
        CalculixError
            If CalculiX fails.
        """
        lines = [*_STORE_MATRICES, *step_lines]
        text = self.model.text(lines, blocks=blocks, free=free, preloaded=preloaded)
        self._run(name, text)
        if not (self.folder / f"{name}.sti").is_file():
            raise CalculixError(
                f"{self.model.path}: CalculiX has stored no stiffness matrix; the deck needs "
                "elements that deform."
            )
        dofs = read_unknowns(self.folder / f"{name}.dof")
        stiffness, _ = read_matrix(self.folder, f"{name}.sti")
        mass, _ = read_matrix(self.folder, f"{name}.mas")
        size = len(dofs)
        stiffness.resize((size, size))
        mass.resize((size, size))
        return StoredMatrices(stiffness, mass, dofs)

    def displacements(
        self,
        loads: Sequence[DeckLoad],
        blocks: Sequence[KeywordBlock],
        *,
        preloaded: bool = True,
        quantity: Literal["U", "RF"] = "U",
    ) -> list[dict[int, FloatArray]]:
        """Let CalculiX compute nodal displacements (3,) under each load alone, in the deck's unit.

        Parameters
        ----------
        preloaded : bool
            Whether the loads follow the preload, if the model has one.
        quantity : "U" or "RF"
            "RF" gives forces at nodes instead: the loads and the reactions.

        Raises
        ------
        CalculixError
            If CalculiX fails.
        """
        steps = []
        for load in loads:
            other_loads_end = ["*CLOAD, OP=NEW", "*DLOAD, OP=NEW"]
            prints = [f"*NODE PRINT, NSET={ALL_NODES}, GLOBAL=YES", quantity]
            steps.append(["*STATIC", *other_loads_end, *load.lines, *prints])
        # A second step of small changes would forget the preload.
        jobs = [steps]
        if preloaded and self.model.preload:
            jobs = [[step] for step in steps]
        blocks = [*blocks, self._set_of_all_nodes()]
        tables: list[FloatArray] = []
        for job in jobs:
            text = self.model.text(*job, blocks=blocks, preloaded=preloaded)
            tables += read_tables(self._run("static", text)).get(ALL_NODES, [])
        if len(tables) != len(loads):
            raise CalculixError(
                f"{self.model.path}: CalculiX printed {len(tables)} static solutions instead of "
                f"{len(loads)}."
            )
        return [{int(row[0]): row[1:] for row in table} for table in tables]

    def frequencies(self, count: int, blocks: Sequence[KeywordBlock]) -> FloatArray:
        """Let CalculiX compute the lowest natural frequencies (count,) [Hz].

        Raises
        ------
        CalculixError
            If CalculiX fails.
        """
        text = self.model.text(["*FREQUENCY", str(count)], blocks=blocks, preloaded=True)
        return read_frequencies(self._run("modes", text))[:count]

    def _set_of_all_nodes(self) -> KeywordBlock:
        """Return the *NSET of the nodes of all elements."""
        numbers = sorted(
            {node for element in self.model.mesh.elements.values() for node in element.nodes}
        )
        return set_block("NSET", ALL_NODES, numbers)

    def _run(self, name: str, text: str) -> str:
        """Run CalculiX on a deck's text and return its table of results.

        If it fails, the `CalculixError` has its message and the line of the deck.
        """
        try:
            return run_calculix(text, self.folder, name, self.time_limit)
        except CalculixError as error:
            log = self.folder / f"{name}.log"
            if not log.is_file():
                job = str(self.folder / f"{name}.inp")
                raise CalculixError(str(error).replace(job, str(self.model.path))) from None
            message = first_error(log.read_text(encoding="utf-8"))
            where = self._line_of(message)
            raise CalculixError(f"{where}: CalculiX did not finish: {message}") from None

    def _line_of(self, message: str) -> str:
        """Return the file and line of the deck that a message cites, or else the file."""
        cited = _without_blanks(message)
        for block in self.model.blocks:
            head, *lines = block_lines(block)
            wheres = [block.where, *(where for where, _ in block.data)]
            for where, line in zip(wheres, [head, *lines], strict=True):
                if _without_blanks(line) in cited and len(line) > len(block.keyword) + 1:
                    return where
        return str(self.model.path)


def _without_blanks(text: str) -> str:
    """Return a text in capital letters, without white space."""
    return re.sub(r"\s+", "", text).upper()
