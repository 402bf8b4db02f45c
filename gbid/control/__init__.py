"""Controllers, closed loops, damping, and what a design is worth."""

from gbid.control.assess import Assessment, assess
from gbid.control.blow_figures import BlowFigures
from gbid.control.blows import Blow, find_blows
from gbid.control.compare import Comparison, compare_designs
from gbid.control.controller_file import load_controller, save_controller
from gbid.control.controllers import p_controller
from gbid.control.curves import SensitivityData, sensitivity_data
from gbid.control.damping import smallest_damping
from gbid.control.design import ControllerDesign
from gbid.control.export_c import export_c
from gbid.control.filters import BiquadStructure, PDStructure, PStructure
from gbid.control.forces import force_entry, static_force_gain
from gbid.control.gain_result import GainResult, SearchStep, WorstMode
from gbid.control.impact import HalfSine, ImpactResponse, impact_response
from gbid.control.impact_modes import ringing_modes
from gbid.control.impact_store import load_impacts, save_impacts
from gbid.control.impact_study import ImpactStudy, study_impacts
from gbid.control.impact_validation import ImpactValidation, validate_impact
from gbid.control.loop import close_loop
from gbid.control.margins import (
    DiskMargin,
    LoopMargins,
    disk_margin,
    disk_margins_by_loop,
    loop_margins,
    slow_poles,
    static_amplification,
    static_stiffness_ratio,
)
from gbid.control.maximise import maximise_damping
from gbid.control.norm import Peak, peak_gain
from gbid.control.pareto_front import ParetoFront, pareto
from gbid.control.point_assessment import PointAssessment
from gbid.control.ringdown import fit_ringdown
from gbid.control.ringdown_result import RingDown
from gbid.control.sampled import SampledLoop, exact_plant, sampled_loop
from gbid.control.sampling import sample_controller, sample_plant
from gbid.control.scheduled import Scheduled, controller_at, scheduled
from gbid.control.sensitivity import Sensitivities, sensitivities
from gbid.control.structures import controller_model, controller_structure
from gbid.control.tuning import tune
from gbid.control.uncertainty import Uncertainty

__all__ = [
    "Assessment",
    "BiquadStructure",
    "Blow",
    "BlowFigures",
    "Comparison",
    "ControllerDesign",
    "DiskMargin",
    "GainResult",
    "HalfSine",
    "ImpactResponse",
    "ImpactStudy",
    "ImpactValidation",
    "LoopMargins",
    "PDStructure",
    "PStructure",
    "ParetoFront",
    "Peak",
    "PointAssessment",
    "RingDown",
    "SampledLoop",
    "Scheduled",
    "SearchStep",
    "Sensitivities",
    "SensitivityData",
    "Uncertainty",
    "WorstMode",
    "assess",
    "close_loop",
    "compare_designs",
    "controller_at",
    "controller_model",
    "controller_structure",
    "disk_margin",
    "disk_margins_by_loop",
    "exact_plant",
    "export_c",
    "find_blows",
    "fit_ringdown",
    "force_entry",
    "impact_response",
    "load_controller",
    "load_impacts",
    "loop_margins",
    "maximise_damping",
    "p_controller",
    "pareto",
    "peak_gain",
    "ringing_modes",
    "sample_controller",
    "sample_plant",
    "sampled_loop",
    "save_controller",
    "save_impacts",
    "scheduled",
    "sensitivities",
    "sensitivity_data",
    "slow_poles",
    "smallest_damping",
    "static_amplification",
    "static_force_gain",
    "static_stiffness_ratio",
    "study_impacts",
    "tune",
    "validate_impact",
]
