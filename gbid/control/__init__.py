"""Control: controllers, closed loops, tuning of gains, impacts, and the assessment of designs."""

from gbid.control.assessment.assess import Assessment, assess
from gbid.control.assessment.compare import Comparison, compare_designs
from gbid.control.assessment.point_assessment import PointAssessment
from gbid.control.controllers.built_in.biquad import BiquadStructure
from gbid.control.controllers.built_in.p import PStructure
from gbid.control.controllers.built_in.pd import PDStructure
from gbid.control.controllers.controller_file import load_controller, save_controller
from gbid.control.controllers.design import ControllerDesign
from gbid.control.controllers.proportional import p_controller
from gbid.control.controllers.scheduled import Scheduled, controller_at, scheduled
from gbid.control.controllers.structures import controller_model, controller_structure
from gbid.control.impact.figures_of_merit import ImpactFigures
from gbid.control.impact.half_sine import HalfSine, ImpactResponse, impact_response
from gbid.control.impact.impact_store import load_impacts, save_impacts
from gbid.control.impact.measured import MeasuredImpact, find_impacts
from gbid.control.impact.ringdown.fit_ringdown import fit_ringdown
from gbid.control.impact.ringdown.ringdown_result import RingDown, RingDownStatus
from gbid.control.impact.ringing_modes import ringing_modes
from gbid.control.impact.study import ImpactStudy, study_impacts
from gbid.control.impact.validation import ImpactValidation, validate_impact
from gbid.control.loop.close import close_loop
from gbid.control.loop.curves import SensitivityData, sensitivity_data
from gbid.control.loop.damping import smallest_damping
from gbid.control.loop.force_entry import force_entry, static_force_gain
from gbid.control.loop.iso_zones import ISO_LIMITS, SensitivityZones, iso_zone, sensitivity_zones
from gbid.control.loop.margins import (
    DiskMargin,
    LoopMargins,
    disk_margin,
    disk_margins_by_loop,
    loop_margins,
    slow_poles,
    static_amplification,
    static_stiffness_ratio,
)
from gbid.control.loop.norm import Peak, peak_gain
from gbid.control.loop.sampled import SampledLoop, exact_plant, sampled_loop
from gbid.control.loop.sampling import sample_controller, sample_plant
from gbid.control.loop.sensitivity import Sensitivities, sensitivities
from gbid.control.tuning.gain_result import GainResult, GainStatus, GoalFigure, WorstMode
from gbid.control.tuning.goals.disturbance import DisturbanceSpectrum, recorded_disturbance
from gbid.control.tuning.goals.goal import Goal, Wanted
from gbid.control.tuning.goals.margin_goals import MinGainMargin, MinPhaseMargin
from gbid.control.tuning.goals.mode_goals import MaxDamping, MaxDecay, MinDamping, SlowestPole
from gbid.control.tuning.goals.response_goals import (
    MinDiskMargin,
    PeakComplementary,
    PeakControl,
    PeakSensitivity,
    ResponseGoal,
    RollOff,
    StaticAmplification,
)
from gbid.control.tuning.goals.rms_goals import RmsControl, RmsGoal, RmsPosition
from gbid.control.tuning.goals.travel_goal import PiezoTravel
from gbid.control.tuning.maximise import maximise_damping
from gbid.control.tuning.pareto import ParetoFront, pareto
from gbid.control.tuning.plants.uncertainty import Uncertainty
from gbid.control.tuning.robust.plant_draws import PlantDraws
from gbid.control.tuning.robust.price import PriceOfRobustness, price_of_robustness
from gbid.control.tuning.robust.tune_robust import RobustDesign, tune_robust
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.tune import tune

__all__ = [
    "ISO_LIMITS",
    "Assessment",
    "BiquadStructure",
    "Comparison",
    "ControllerDesign",
    "DiskMargin",
    "DisturbanceSpectrum",
    "GainResult",
    "GainStatus",
    "Goal",
    "GoalFigure",
    "HalfSine",
    "ImpactFigures",
    "ImpactResponse",
    "ImpactStudy",
    "ImpactValidation",
    "LoopMargins",
    "MaxDamping",
    "MaxDecay",
    "MeasuredImpact",
    "MinDamping",
    "MinDiskMargin",
    "MinGainMargin",
    "MinPhaseMargin",
    "PDStructure",
    "PStructure",
    "ParetoFront",
    "Peak",
    "PeakComplementary",
    "PeakControl",
    "PeakSensitivity",
    "PiezoTravel",
    "PlantDraws",
    "PointAssessment",
    "PriceOfRobustness",
    "ResponseGoal",
    "RingDown",
    "RingDownStatus",
    "RmsControl",
    "RmsGoal",
    "RmsPosition",
    "RobustDesign",
    "RollOff",
    "SampledLoop",
    "Scheduled",
    "SearchStep",
    "Sensitivities",
    "SensitivityData",
    "SensitivityZones",
    "SlowestPole",
    "StaticAmplification",
    "Uncertainty",
    "Wanted",
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
    "find_impacts",
    "fit_ringdown",
    "force_entry",
    "impact_response",
    "iso_zone",
    "load_controller",
    "load_impacts",
    "loop_margins",
    "maximise_damping",
    "p_controller",
    "pareto",
    "peak_gain",
    "price_of_robustness",
    "recorded_disturbance",
    "ringing_modes",
    "sample_controller",
    "sample_plant",
    "sampled_loop",
    "save_controller",
    "save_impacts",
    "scheduled",
    "sensitivities",
    "sensitivity_data",
    "sensitivity_zones",
    "slow_poles",
    "smallest_damping",
    "static_amplification",
    "static_force_gain",
    "static_stiffness_ratio",
    "study_impacts",
    "tune",
    "tune_robust",
    "validate_impact",
]
