"""Reduced models kept between runs: an unchanged design is built once, a changed one is built anew."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fe.runtime.archive import write_bytes_atomically
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.reduced import ReducedModel

from .built_once import built_once, cache_folder, kept
from .fields import FieldBasis, WingFields, field_basis

if TYPE_CHECKING:
    from fe.full.operators import AffineOperators
    from fe.wing.design import WingDesign

    from .patch_basis import PatchSettings
    from .settings import ReductionSettings
    from .stages import Progress

MODELLING_ROOMS = ("runtime", "wing", "full", "reduction")
"""The rooms that decide what a reduced model holds; a change in any of their files makes a new entry."""


def modelling_hash(rooms: tuple[str, ...] = MODELLING_ROOMS) -> str:
    """Return the SHA-256 of the modelling code of some rooms, hexadecimal."""
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for room in rooms:
        for path in sorted((package / room).rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def cache_key(design: "WingDesign", settings: "ReductionSettings | PatchSettings | None" = None) -> str:
    """Return the name of a cache entry: a hash of design, reduction settings and modelling code."""
    content = f"{design.hash} {settings!r} {modelling_hash()}"
    return hashlib.sha256(content.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class _Entry:
    """The two files of one cache entry."""

    model: Path
    fields: Path


def _entry(design: "WingDesign", settings: "ReductionSettings | None") -> _Entry:
    key = cache_key(design, settings)
    return _Entry(cache_folder() / f"wing-{key}.npz", cache_folder() / f"wing-{key}-fields.npz")


def reduced_model(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "ReductionSettings | None" = None,
) -> ReducedModel:
    """Return the reduced model of a design, from the cache if it is there.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one if left out.
    progress : Progress, optional
        Where a build reports.
    settings : ReductionSettings, optional
        Where and how well the model is to hold.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = given_or_shipped(design)
    entry = _entry(wing, settings)
    return kept(lambda: _checked_model(entry.model, wing)) or _build(wing, progress, settings).model


def wing_fields(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "ReductionSettings | None" = None,
) -> WingFields:
    """Return the reduced model of a design with its field basis, from the cache if both are there.

    Parameters and errors as of `reduced_model`.
    """
    wing = given_or_shipped(design)
    entry = _entry(wing, settings)
    return kept(lambda: _checked_fields(entry, wing)) or _build(wing, progress, settings)


def given_or_shipped(design: "WingDesign | None") -> "WingDesign":
    """Return a design, the shipped one if none is given."""
    if design is not None:
        return design
    from fe.wing.design import load_design

    return load_design()


def _checked_model(path: Path, design: "WingDesign") -> ReducedModel:
    model = ReducedModel.load(path)
    if model.design_hash != design.hash:
        raise ReducedModelFileError(f"{path} holds the model of another design; delete it.")
    return model


def _checked_fields(entry: _Entry, design: "WingDesign") -> WingFields:
    model = _checked_model(entry.model, design)
    return WingFields(model, FieldBasis.from_bytes(entry.fields.read_bytes(), str(entry.fields)))


def _build(
    design: "WingDesign", progress: "Progress | None", settings: "ReductionSettings | None"
) -> WingFields:
    entry = _entry(design, settings)

    def keep(wing: WingFields) -> None:
        # the model last: where it is, its fields are
        write_bytes_atomically(entry.fields, wing.basis.to_bytes())
        write_bytes_atomically(entry.model, wing.model.to_bytes())

    return built_once(
        entry.model,
        load=lambda: _checked_fields(entry, design),
        build=lambda: build(design, progress, settings),
        keep=keep,
    )


def build(
    design: "WingDesign", progress: "Progress | None" = None, settings: "ReductionSettings | None" = None
) -> WingFields:
    """Build the reduced model and the field basis of a design, without the cache.

    It works in one thread, because sums over several threads depend on their number: a design gives the
    same bytes on a machine whatever its cores do.

    Parameters and errors as of `reduced_model`.
    """
    from .reduced_basis import reduce_model

    with assembled(design, progress) as operators:
        reduction = reduce_model(operators, settings, progress)
        return WingFields(reduction.model, field_basis(operators, reduction))


@contextmanager
def assembled(design: "WingDesign", progress: "Progress | None") -> "Iterator[AffineOperators]":
    """Give the full model of a design, and hold the process to one thread meanwhile."""
    from threadpoolctl import threadpool_limits

    from fe.full.operators import assemble

    from .stages import stage_of

    with threadpool_limits(1):
        with stage_of(progress, "Meshing and assembling the wing"):
            operators = assemble(design)
        yield operators
