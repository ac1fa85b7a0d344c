"""Errors of structural models, named by their cause.

Standard library only: this file is copied into the FMU.
"""


class FiniteElementError(Exception):
    """Any error that the packages of structures raise on purpose."""


class InvalidStateError(FiniteElementError, ValueError):
    """A digital state holds a value that no structure can have."""


class InvalidDesignError(FiniteElementError, ValueError):
    """A wing design cannot be built; the sentence names the table and the key."""


class DesignFileError(InvalidDesignError):
    """A design file cannot be read or is not TOML."""


class MeshError(FiniteElementError, RuntimeError):
    """The mesh does not hold what the design asked for."""


class OutsideModelError(FiniteElementError, ValueError):
    """A value lies outside the range for which the reduced model was made."""


class InvalidPatchError(FiniteElementError, ValueError):
    """A model patch cannot be read, or the model cannot carry it."""


class PlugInError(FiniteElementError, ImportError):
    """What an installed package adds cannot be loaded, or does not fit."""


class SolutionError(FiniteElementError, RuntimeError):
    """A linear or eigenvalue solution did not reach the accuracy that was asked for."""


class ReducedModelFileError(FiniteElementError, RuntimeError):
    """A stored reduced model is damaged, incomplete or of another format."""


class ReductionError(FiniteElementError, RuntimeError):
    """The reduced model did not reach the accuracy that was asked for."""


class CalculixError(FiniteElementError, RuntimeError):
    """CalculiX is not installed, did not finish, or printed something unexpected."""
