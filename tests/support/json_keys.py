"""Keys of the documents that verbs print with `--json`: programs rely on them."""

import re

_TEXT = """
run: crossval, crossval_summary, cycle, excite, experiment, figures, fits, impacts, loops, lpv, nominal, outcomes,
    prefilter, report, results, static, target, tuning
fits: aic, condition, fit, fit_percent, fpe, iterations, loss, model, modes, multi_start, notes, options, parameters,
    path, profiles, recordings, state, static_gain, status, structure, success, trusted, wall_time_s, whiteness
fits.parameters: deviation_percent, deviation_std, estimate, fixed, parameter, start, start_origin, std, std_robust,
    std_white, truth, unit
fits.modes: damping, damping_std, frequency_hz, frequency_std_hz, mode, true_damping, true_frequency_hz
fits.static_gain: gain, input, output, std, truth
fits.fit_percent: fit_percent, output, recording
fits.whiteness: output, p_value
static: channel, conditions, creep, dof, gains, hysteresis, hysteresis_at, hysteresis_share, hysteresis_std, kind,
    name, notes, offset, path, plateaus, range, recordings, saturated_steps, state, step_gain, steps, uniformity,
    units
crossval: fit, fit_percent, infinity_norm, minimum_percent, missed, model, output, recording, residual_p,
    residuals_follow, residuals_white, unit
crossval_summary: below, counts, edges, failed, fit, greatest, infinity_norm_max, infinity_norm_mean, least, mean,
    median, n_models, n_pairs, n_recordings, output_names, output_units, path, points, std, worst
crossval_summary.worst: fit_percent, infinity_norm, model, output, recording
crossval_summary.points: infinity_norm, mean, n_pairs, pressure_bar, speed_rpm, std
nominal: chosen_from, distance, fit, left_out, model, outliers, parameters, path, std
lpv: coefficients, coefficients_std, deviations, item, lack_of_fit, left_out, model, notes, operating_points, options,
    orders, outliers, path, recordings, scatter_std, status, success
lpv.deviations: largest, name, published_rms, recording, rms, unit
lpv.orders: order, score, why_not
tuning: active, controller, design, gains, goals, impact, method, notes, objective, pareto, path, peak_control,
    peak_sensitivity, performance, plant, points, promises, sample_time_s, static_amplification, status, structure,
    success, value, verified_on, violation, worst
tuning.performance: gains, name, points, structure, worst
tuning.pareto: active, cap, gains, goals, notes, objective, peak_control, peak_sensitivity, static_amplification,
    status, success, value, verified_on, violation, worst
tuning.worst: damping, frequency_hz, where
impacts: controller, impacts, lag_rates, loop, model, modes, name, notes, path, pressure_bar, published, residual_rms,
    responses, speed_rpm, status, success
impacts.modes: converged, expected_damping, expected_frequency [Hz], impacts, lags, loop, mode, obtained_damping,
    obtained_damping_std, obtained_frequency [Hz], obtained_frequency_std [Hz], pressure_bar, running_damping,
    running_frequency [Hz], speed_rpm
impacts.responses: axis, decay [s], decay_simulated [s], decay_std [s], fit_along [%], fit_x [%], fit_y [%],
    force_scale [1/kg], force_scale_std [1/kg], impacts, loop, peak [m], peak_simulated [m], peak_std [m], piezo [m],
    piezo_simulated [m], piezo_std [m], pressure_bar, recording, speed_rpm
prefilter: channel, first_spikes, harmonics, notes, offset, recording, rms_after, rms_before, runout_share, spikes,
    unit
"""
_ENTRY = re.compile(r"^([\w.]+): ((?:.|\n    )+)", re.MULTILINE)
KEYS = {name: re.split(r",\s+", keys.strip()) for name, keys in _ENTRY.findall(_TEXT)}


def assert_keys(section, document):
    """The entry of a section has the known keys, and so have the rows within it."""
    rows = document[section] if isinstance(document[section], list) else [document[section]]
    assert rows, section
    for row in rows:
        assert set(row) <= set(KEYS[section]), section
    assert set().union(*rows) == set(KEYS[section]), section
    for name, keys in KEYS.items():
        outer, _, inner = name.partition(".")
        if outer == section and inner:
            for row in rows:
                for part in row[inner] if isinstance(row[inner], list) else [row[inner]]:
                    assert set(part) == set(keys), name
