"""How many of the decks that come with CalculiX the mesh reader and `structure from-deck` take.

Shown in docs/how_to/calculix_decks.md.

`python -m benchmarks.studies.calculix_decks --examples FOLDER --out records.jsonl` unpacks the
decks of Debian's package `calculix-ccx-test` (`dpkg -L calculix-ccx-test`), tries each with the
mesh reader and with the command, and prints how many are accepted, the largest deviation from
CalculiX, and the reasons of the others. Each deck has one line in the file of records; decks that
have a line already are not tried again, so that an interrupted study goes on.
"""

import argparse
import gzip
import json
import multiprocessing
import re
import resource
import shutil
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from rich.console import Console
from rich.table import Table

from fe.runtime.errors import FiniteElementError
from fe.solver_deck.conversion import DeckOptions, convert_deck
from fe.structure.mesh_file import read_mesh
from fe.structure.tables import UNITS

EXAMPLES = Path("/usr/share/doc/calculix-ccx-test/examples/test")
"""Where Debian's package puts the decks."""
SECONDS = 25.0
"""Processor time for each deck, and for each run of CalculiX on it [s]."""

_TIME_REASON = "more than the time limit"
_REASONS = {
    "no *ELASTIC: heat, electricity, hyperelastic and user materials": r"a material with \*ELASTIC",
    "cyclic symmetry": r"\*CYCLIC SYMMETRY MODEL is one sector",
    "flow or fluid networks": r"computes a flow",
    "electromagnetic fields": "electromagnetic field",
    "submodel, restart or user elements": r"\*SUBMODEL|\*RESTART|\*USER ELEMENT",
    _TIME_REASON: "CalculiX took more than|seconds for a deck",
    "CalculiX does not finish": "CalculiX did not finish|printed no eigenvalues|static solutions",
    "the result differs from that of CalculiX": "must agree to",
    "the preload makes it unstable, or changes its unknowns": "preload",
    "nothing that can be compared": "frequenc.* that could be compared",
    "motions left free, or a singular matrix": "cannot be solved|before its matrices|singular",
    "a matrix that is not finite or not symmetric": "not finite|not symmetric",
    "regions that overlap": "regions must not overlap",
    "more sections than regions": "one to 8 regions",
    "empty decks": "no keyword|with elements is expected|has stored no stiffness",
}
"""A pattern of the messages of each reason of refusal; the first that matches counts."""


@dataclass(frozen=True)
class DeckRecord:
    """What became of one deck.

    Attributes
    ----------
    deck : str
        Name of the file.
    mesh_refusal : str
        Message of the mesh reader; empty if it takes the deck.
    refusal : str
        Message of `structure from-deck`; empty if it takes the deck.
    displacement_deviations : dict of str to float
        Largest relative deviation from CalculiX under each load.
    frequency_deviation : float or None
        Largest relative deviation of a frequency; None if none was compared.
    remarks : list of str
        What the command says of the deck.
    """

    deck: str
    mesh_refusal: str = ""
    refusal: str = ""
    displacement_deviations: dict[str, float] = field(default_factory=dict)
    frequency_deviation: float | None = None
    remarks: list[str] = field(default_factory=list)

    @property
    def largest_deviation(self) -> float:
        """The largest relative deviation from CalculiX."""
        return max([*self.displacement_deviations.values(), self.frequency_deviation or 0.0])

    @property
    def reason(self) -> str:
        """The reason of the refusal, in the words of the table."""
        for reason, pattern in _REASONS.items():
            if re.search(pattern, self.refusal):
                return reason
        return "other"


def unpack_decks(examples: Path, folder: Path) -> list[Path]:
    """Copy all decks into a folder, unpacked, and return them in the order of their names."""
    for source in examples.glob("*.inp*"):
        if source.suffix == ".gz":
            with gzip.open(source, "rb") as packed, (folder / source.stem).open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked)
        elif source.suffix == ".inp":
            shutil.copy(source, folder / source.name)
    return sorted(folder.glob("*.inp"))


def try_deck(deck: Path, seconds: float) -> DeckRecord:
    """Try one deck in a process of its own, so that neither a crash nor its memory stays.

    Parameters
    ----------
    deck : Path
        The deck.
    seconds : float
        Processor time that the process, and each run of CalculiX, may take [s].
    """
    # A fork of this process would have the locks of its threads, such as those of BLAS.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.studies.calculix_decks"])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_record, args=(deck, seconds, sender))
    process.start()
    sender.close()
    try:
        record: DeckRecord = receiver.recv()
    except EOFError:
        record = DeckRecord(deck.name, refusal=f"more than {seconds:g} seconds for a deck")
    process.join()
    return record


def _send_record(deck: Path, seconds: float, sender: Connection) -> None:
    """Try a deck within a limit of processor time, and send the record."""
    limit = max(1, round(seconds))
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    sender.send(_record_of(deck))


def _record_of(deck: Path) -> DeckRecord:
    """Return what the mesh reader and the conversion say of a deck."""
    mesh_refusal = ""
    try:
        read_mesh(deck, UNITS["mm"], "mm")
    except FiniteElementError as error:
        mesh_refusal = str(error)
    with tempfile.TemporaryDirectory() as folder:
        try:
            report = convert_deck(deck, Path(folder), "structure", DeckOptions())
        except FiniteElementError as error:
            refusal = " ".join(str(error).split())
            return DeckRecord(deck.name, mesh_refusal=mesh_refusal, refusal=refusal)
    return DeckRecord(
        deck=deck.name,
        mesh_refusal=mesh_refusal,
        displacement_deviations=report.load_deviations,
        frequency_deviation=report.frequency_deviation if len(report.frequencies) else None,
        remarks=report.remarks,
    )


def read_records(file: Path) -> list[DeckRecord]:
    """Read the records of an earlier study; none if there is no file."""
    if not file.is_file():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    return [DeckRecord(**json.loads(line)) for line in lines]


def print_study(records: list[DeckRecord]) -> None:
    """Print the counts, the deviations and the reasons."""
    console = Console(width=110)
    accepted = [record for record in records if not record.refusal]
    with_displacements = [record for record in accepted if record.displacement_deviations]
    with_frequencies = [record for record in accepted if record.frequency_deviation is not None]
    in_both = [record for record in with_displacements if record in with_frequencies]
    loads = sum(len(record.displacement_deviations) for record in accepted)
    console.print(f"{len(records)} decks")
    console.print(f"mesh reader: {sum(not record.mesh_refusal for record in records)}")
    console.print(f"from-deck: {len(accepted)}")
    console.print(
        f"compared in displacements and frequencies {len(in_both)}, in displacements alone "
        f"{len(with_displacements) - len(in_both)}, in frequencies alone "
        f"{len(with_frequencies) - len(in_both)}; {loads} loads"
    )
    if accepted:
        worst = max(accepted, key=lambda record: record.largest_deviation)
        console.print(f"largest deviation: {worst.largest_deviation:.1e} ({worst.deck})")
    table = Table("reason", "decks", "first of them")
    refused = [record for record in records if record.refusal]
    for reason, count in Counter(record.reason for record in refused).most_common():
        names = [record.deck for record in refused if record.reason == reason]
        table.add_row(reason, str(count), ", ".join(names[:4]))
    console.print(table)
    for record in refused:
        if record.reason == "other":
            console.print(f"{record.deck}: {record.refusal}")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=Path, default=EXAMPLES, help="folder of the decks")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="processor time [s]")
    parser.add_argument("--out", type=Path, required=True, help="file of records, a line for each")
    arguments = parser.parse_args()
    records = read_records(arguments.out)
    earlier = {record.deck for record in records}
    with tempfile.TemporaryDirectory() as folder:
        for deck in unpack_decks(arguments.examples, Path(folder)):
            if deck.name in earlier:
                continue
            record = try_deck(deck, arguments.seconds)
            records.append(record)
            with arguments.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(record)) + "\n")
    print_study(records)


if __name__ == "__main__":
    main()
