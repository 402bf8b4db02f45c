"""Figures of Theisen et al. 2016 that belong to no model file; each stands here alone."""

from __future__ import annotations

PUBLISHED_RMS = {
    "tau_x": 0.088e-3,
    "tau_y": 0.041e-3,
    "omega_1": 1.13,
    "omega_2": 0.58,
    "zeta_1": 0.0104,
    "zeta_2": 0.0063,
    "g_xx": 0.0031,
    "g_xy": 0.0022,
    "g_yx": 0.0027,
    "g_yy": 0.0031,
}
"""Rms deviations of 86 recordings from the surfaces (Sec. 4): delays [s], frequencies [Hz], damping, gains [m/m]."""

PUBLISHED_LARGEST_GAIN = 0.016
"""Largest deviation of a static gain from its surface [m/m] (Sec. 4)."""
