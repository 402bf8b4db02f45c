"""Public names of `gbid.control`, and the files that define them: the one list."""

from .assessment import (
    assess as assess,
    compare_designs as compare_designs,
)
from .controllers.built_in import (
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
from .impact.ringdown import (
    fit_ringdown as fit_ringdown,
)
from .impact.study import (
    ImpactStudy as ImpactStudy,
    ringing_modes as ringing_modes,
    study_impacts as study_impacts,
    validate_impact as validate_impact,
)
from .loop.close import (
    close_loop as close_loop,
    sample_controller as sample_controller,
    smallest_damping as smallest_damping,
)
from .loop.half_sine import (
    HalfSine as HalfSine,
    impact_response as impact_response,
)
from .loop.norm import (
    peak_gain as peak_gain,
)
from .loop.sampled import (
    exact_plant as exact_plant,
    sampled_loop as sampled_loop,
)
from .loop.sensitivity import (
    ISO_LIMITS as ISO_LIMITS,
    Sensitivities as Sensitivities,
    disk_margin as disk_margin,
    disk_margins_by_loop as disk_margins_by_loop,
    loop_margins as loop_margins,
    sensitivities as sensitivities,
    sensitivity_data as sensitivity_data,
    sensitivity_zones as sensitivity_zones,
    slow_poles as slow_poles,
    static_amplification as static_amplification,
)
from .proof import (
    Proof as Proof,
    ProofStatus as ProofStatus,
    WorstPlant as WorstPlant,
    prove as prove,
)
from .tuning.goals import (
    DisturbanceSpectrum as DisturbanceSpectrum,
    FastestPole as FastestPole,
    Goal as Goal,
    MaxDamping as MaxDamping,
    MaxDecay as MaxDecay,
    MinDamping as MinDamping,
    RmsControl as RmsControl,
    RmsPosition as RmsPosition,
    SlowestPole as SlowestPole,
    recorded_disturbance as recorded_disturbance,
)
from .tuning.plants import (
    TuneOptions as TuneOptions,
    Uncertainty as Uncertainty,
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
    RmsResponse as RmsResponse,
    RollOff as RollOff,
    StaticAmplification as StaticAmplification,
)
from .tuning.result import (
    GainResult as GainResult,
    GainStatus as GainStatus,
)
from .tuning.robust import (
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
