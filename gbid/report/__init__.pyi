"""Public names of `gbid.report`, and the files that define them: the one list."""

from .canvas import (
    save_figure as save_figure,
)
from .diagrams import (
    plot_closed_loop as plot_closed_loop,
    plot_differential_pairing as plot_differential_pairing,
    plot_identification_flow as plot_identification_flow,
    plot_rotor_bearing_model as plot_rotor_bearing_model,
)
from .impact_pictures import (
    impact_data as impact_data,
    impact_loops_data as impact_loops_data,
    impact_validation_data as impact_validation_data,
    plot_impact as plot_impact,
    plot_impact_loops as plot_impact_loops,
)
from .loop_pictures import (
    damping_map_data as damping_map_data,
    designs_pareto_data as designs_pareto_data,
    plot_cycle as plot_cycle,
    plot_damping_map as plot_damping_map,
    plot_magnitudes as plot_magnitudes,
    plot_pareto as plot_pareto,
    plot_robustness_price as plot_robustness_price,
    plot_root_locus as plot_root_locus,
    root_locus_data as root_locus_data,
)
from .measured_pictures import (
    plot_actuator_parameters as plot_actuator_parameters,
    plot_fit_histogram as plot_fit_histogram,
    plot_piezo_hysteresis as plot_piezo_hysteresis,
    plot_piezo_staircase as plot_piezo_staircase,
    plot_recording as plot_recording,
    plot_residuals as plot_residuals,
    plot_response as plot_response,
    plot_static_map as plot_static_map,
)
from .model_pictures import (
    plot_bode as plot_bode,
    plot_campbell as plot_campbell,
    plot_impulse as plot_impulse,
    plot_iso_zones as plot_iso_zones,
    plot_orbit as plot_orbit,
    plot_poles as plot_poles,
    plot_orders as plot_orders,
    plot_profile as plot_profile,
    plot_recursive_fit as plot_recursive_fit,
    plot_step as plot_step,
)
from .pictures import (
    plot as plot,
)
from .surface_pictures import (
    fit_over_pressure_data as fit_over_pressure_data,
    fit_surfaces_data as fit_surfaces_data,
    over_pressure_data as over_pressure_data,
    plot_over_pressure as plot_over_pressure,
    plot_surfaces as plot_surfaces,
    surfaces_data as surfaces_data,
)
