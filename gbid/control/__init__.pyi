"""Public names of `gbid.control`, and the files that define them: the one list."""

from .assessment import (
    Assessment as Assessment,
    Comparison as Comparison,
    PointAssessment as PointAssessment,
    assess as assess,
    compare_designs as compare_designs,
)
from .controllers.built_in import (
    BiquadStructure as BiquadStructure,
    PDStructure as PDStructure,
    PStructure as PStructure,
    state_feedback as state_feedback,
)
from .controllers.file import (
    ControllerDesign as ControllerDesign,
    load_controller as load_controller,
    save_controller as save_controller,
)
from .controllers.structures import (
    Scheduled as Scheduled,
    controller_at as controller_at,
    controller_model as controller_model,
    controller_structure as controller_structure,
    p_controller as p_controller,
    scheduled as scheduled,
)
from .impact.measured import (
    MeasuredImpact as MeasuredImpact,
    find_impacts as find_impacts,
)
from .impact.ringdown import (
    RingDown as RingDown,
    RingDownStatus as RingDownStatus,
    fit_ringdown as fit_ringdown,
)
from .impact.study import (
    ImpactFigures as ImpactFigures,
    ImpactStudy as ImpactStudy,
    ImpactValidation as ImpactValidation,
    ringing_modes as ringing_modes,
    study_impacts as study_impacts,
    validate_impact as validate_impact,
)
from .loop.close import (
    close_loop as close_loop,
    force_entry as force_entry,
    sample_controller as sample_controller,
    sample_plant as sample_plant,
    smallest_damping as smallest_damping,
    static_force_gain as static_force_gain,
)
from .loop.half_sine import (
    HalfSine as HalfSine,
    ImpactResponse as ImpactResponse,
    impact_response as impact_response,
)
from .loop.norm import (
    Peak as Peak,
    peak_gain as peak_gain,
)
from .loop.sampled import (
    SampledLoop as SampledLoop,
    exact_plant as exact_plant,
    sampled_loop as sampled_loop,
)
from .loop.sensitivity import (
    ISO_LIMITS as ISO_LIMITS,
    DiskMargin as DiskMargin,
    LoopMargins as LoopMargins,
    Sensitivities as Sensitivities,
    SensitivityData as SensitivityData,
    SensitivityZones as SensitivityZones,
    disk_margin as disk_margin,
    disk_margins_by_loop as disk_margins_by_loop,
    iso_zone as iso_zone,
    loop_margins as loop_margins,
    sensitivities as sensitivities,
    sensitivity_data as sensitivity_data,
    sensitivity_zones as sensitivity_zones,
    slow_poles as slow_poles,
    static_amplification as static_amplification,
    static_stiffness_ratio as static_stiffness_ratio,
)
from .tuning.goals import (
    DisturbanceSpectrum as DisturbanceSpectrum,
    FastestPole as FastestPole,
    Goal as Goal,
    MaxDamping as MaxDamping,
    MaxDecay as MaxDecay,
    MinDamping as MinDamping,
    RmsControl as RmsControl,
    RmsGoal as RmsGoal,
    RmsPosition as RmsPosition,
    SlowestPole as SlowestPole,
    Wanted as Wanted,
    recorded_disturbance as recorded_disturbance,
)
from .tuning.plants import (
    TuneOptions as TuneOptions,
    Uncertainty as Uncertainty,
)
from .tuning.problem import (
    SearchStep as SearchStep,
)
from .tuning.response_goals import (
    AxisSensitivity as AxisSensitivity,
    MinDiskMargin as MinDiskMargin,
    MinGainMargin as MinGainMargin,
    MinPhaseMargin as MinPhaseMargin,
    PeakComplementary as PeakComplementary,
    PeakControl as PeakControl,
    PeakResponse as PeakResponse,
    PeakSensitivity as PeakSensitivity,
    PiezoTravel as PiezoTravel,
    ResponseGoal as ResponseGoal,
    RmsResponse as RmsResponse,
    RollOff as RollOff,
    StaticAmplification as StaticAmplification,
)
from .tuning.result import (
    GainResult as GainResult,
    GainStatus as GainStatus,
    GoalFigure as GoalFigure,
    WorstMode as WorstMode,
)
from .tuning.robust import (
    PlantDraws as PlantDraws,
    PriceOfRobustness as PriceOfRobustness,
    RobustDesign as RobustDesign,
    RobustOptions as RobustOptions,
    price_of_robustness as price_of_robustness,
    tune_robust as tune_robust,
)
from .tuning.solve import (
    maximise_damping as maximise_damping,
)
from .tuning.tune import (
    ParetoFront as ParetoFront,
    pareto as pareto,
    tune as tune,
)
