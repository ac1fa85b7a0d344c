"""The joint Bayesian posterior of the digital state: load test, weighed masses and ring-down together."""

from .frequency_table import WingTables, tabulate_wing
from .inference import joint_posterior
from .measurement import ModalMeasurement, modal_measurement, published_modal_measurement
from .prior import JointPrior, ModelError, WeighedMass
from .result import NAMES, JointDiagnostics, JointPosterior

__all__ = [
    "NAMES",
    "JointDiagnostics",
    "JointPosterior",
    "JointPrior",
    "ModalMeasurement",
    "ModelError",
    "WeighedMass",
    "WingTables",
    "joint_posterior",
    "modal_measurement",
    "published_modal_measurement",
    "tabulate_wing",
]
