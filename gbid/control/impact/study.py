"""Impact studies of one operating point and loop: validation, force scale, motion, modes (Tables 3 and 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from gbid.control.impact.measured import (
    MeasuredImpact,
    find_impacts,
    force_of,
    force_response,
    loop_of_impact,
    pulses_of,
)
from gbid.control.impact.ringdown import (
    RingDown,
    covariance_of_sum,
    fit_ringdown,
    harmonics_for,
    quiet_basis,
)
from gbid.control.loop.close import force_entry
from gbid.control.loop.sampled import exact_plant
from gbid.core import hdf5
from gbid.core.arrays import FloatArray, one_of_each_pair, oscillatory_modes, point_label
from gbid.core.brief import Brief
from gbid.core.errors import DataError
from gbid.core.hdf5 import Stored
from gbid.core.tables import Column, Entry, Row, Table, formatted, keyed_table, shown_unit
from gbid.lpv import LPVModel
from gbid.recording import Recording
from gbid.structure import LinearModel, PiezoPair
from gbid.structure.linear import evaluate
from gbid.validate.simulate import fit_percent

_DIED_OUT = 0.01  # the response has decayed when the simulation is below this share of its largest value
_BEFORE = 25  # samples before an impact in a figure


@dataclass(frozen=True, eq=False)
class ImpactValidation(Brief):
    """Measured and simulated response, as `validate_impact` returns them.

    Attributes
    ----------
    force_scale : float
        g_f [1/kg], the inverse of the moving mass.
    force_scale_std : float
        Its standard deviation [1/kg], from residuals that are correlated in time and from the noise of the force.
    fit_percent : (2,) array
        ``100 (1 - |p - g_f p_s| / |p - mean p|)`` of x and y over the responses to the impacts, without offset and
        harmonics.
    along_percent : float
        Fit percent of the motion in the direction of the impacts.
    time : (n_samples,) array
        Time [s].
    measured : (n_samples, 2) array
        Measured position minus its offset, with unbalance and run-out [m].
    stationary : (n_samples, 2) array
        Part of it that is synchronous with the shaft [m]; zero at rest.
    simulated : (n_samples, 2) array
        ``g_f`` times the simulated response for a mass of 1 kg [m].
    force : (n_samples, 2) array
        Measured force [N].
    windows : tuple of (start, stop)
        Sample ranges of each impact with its response.
    impacts : tuple of MeasuredImpact
        Impacts in the recording.
    harmonics : int
        Number of estimated harmonics of the shaft angle.
    recording, loop : str
        Names of the recording and of the loop.
    """

    force_scale: float
    force_scale_std: float
    fit_percent: Annotated[FloatArray, Stored("%", "fit of simulated to measured response, x and y", "2")]
    along_percent: float
    time: Annotated[FloatArray, Stored("s", "time", "samples")]
    measured: Annotated[FloatArray, Stored("m", "position as measured, less its offset", "samples 2")]
    stationary: Annotated[FloatArray, Stored("m", "part of it that turns with the shaft", "samples 2")]
    simulated: Annotated[FloatArray, Stored("m", "simulated response, scaled", "samples 2")]
    force: Annotated[FloatArray, Stored("N", "measured force", "samples 2")]
    windows: Annotated[tuple[tuple[int, int], ...], Stored("1", "samples of each impact and the response to it")]
    impacts: tuple[MeasuredImpact, ...]
    harmonics: int
    recording: str
    loop: str

    @property
    def axis(self) -> str:
        """``"x"``, ``"y"``, or ``"xy"`` when there are impacts along both axes."""
        return "".join(sorted({impact.axis for impact in self.impacts}))

    @property
    def shown(self) -> slice:
        """Samples of the first impact for a figure: from just before the impact until the response has decayed."""
        start, stop = self.windows[0]
        return slice(max(0, start - _BEFORE), stop)


def validate_impact(
    recording: Recording,
    plant: LinearModel,
    controller: LinearModel | None = None,
    *,
    position: str = "p",
    force: str = "f",
    axis: str | None = None,
    harmonics: int | None = None,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> ImpactValidation:
    r"""Return the force scale with measured and simulated impact responses (paper, Sec. 5.1).

    g_f is the linear least-squares factor between the measured response and the simulated response for a mass of 1
    kg, :math:`p = g_f\, G_b f` (Eq. 8) or :math:`p = g_f\, S_o G_b f`. An offset and, when the shaft turns, harmonics
    of its angle are estimated together with it.

    Parameters
    ----------
    recording : Recording
        Recording with position, force of the hammer and, when the shaft turns, its angle `phi`.
    plant : LinearModel
        Continuous plant, from r (or u) to p: `LPVModel.plant_at`, or `gbid.control.exact_plant` for a sampled
        controller.
    controller : LinearModel, optional
        Controller during the recording; open loop when not given. A continuous controller gives the loop of the
        paper, a sampled one (`gbid.control.sample_controller`) gives the sampled loop.
    position, force : str
        Names of the signals.
    axis : {"x", "y"}, optional
        Direction of a force with one channel.
    harmonics : int, optional
        Number of harmonics; by default 10 when the shaft turns.
    computation_s : float, optional
        Time from the sample of p to the change of r, for sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    ImpactValidation

    Raises
    ------
    DataError
        When the recording has no impact, or when a signal is missing or of another shape.
    UsageError
        When models do not fit together, or when the loop is unstable.
    """
    h, n = recording.sample_time, recording.n_samples
    f = force_of(recording, force, axis)
    p = recording.signal(position)
    if p.shape[1] != 2:
        raise DataError(f"recording {recording.name!r}: {position!r} has {p.shape[1]} channels; an impact needs two")
    impacts = find_impacts(f, h, recording.name)
    response = force_response(plant, controller, pulses_of(f, impacts), n, h, computation_s=computation_s, entry=entry)
    count = harmonics_for(recording, harmonics)
    basis = quiet_basis(recording, count)
    q, r = np.linalg.qr(basis)
    free = response - q @ (q.T @ response)
    energy = float((free**2).sum())
    g = float((free * p).sum()) / energy
    quiet = np.linalg.solve(r, q.T @ (p - g * response))
    simulated = g * response
    measured, stationary = p - quiet[0], basis[:, 1:] @ quiet[1:]
    residual = measured - stationary - simulated
    windows = _windows(response, impacts)
    rows = np.concatenate([np.arange(*window) for window in windows])
    motion, modelled = (measured - stationary)[rows], simulated[rows]
    direction = np.repeat([impact.along for impact in impacts], [stop - start for start, stop in windows], axis=0)
    along = [(part * direction).sum(axis=1)[:, None] for part in (motion, modelled)]
    # standard deviation of g from the residuals, and from the noise of the force between the impacts
    used = np.ones(n, dtype=bool)
    from_position = covariance_of_sum([free[:, :, None]], [residual], [used], h).item() / energy**2
    for impact in impacts:
        used[impact.start : impact.stop + 1] = False
    noise = float(np.sqrt(np.mean(f[used] ** 2)))
    energies = np.array([float((response[start:stop] ** 2).sum()) for start, stop in windows])
    impulses = np.array([np.hypot(*f[b.start : b.stop + 1].sum(axis=0)) for b in impacts])
    relative = noise * np.sqrt([b.stop - b.start + 1 for b in impacts]) / impulses
    from_force = g**2 * float((energies**2 * relative**2).sum()) / float(energies.sum()) ** 2
    return ImpactValidation(
        g,
        float(np.sqrt(from_position + from_force)),
        fit_percent(motion, modelled),
        float(fit_percent(*along)[0]),
        np.asarray(recording.time),
        measured,
        stationary,
        simulated,
        f,
        windows,
        impacts,
        count,
        recording.name,
        "open loop" if controller is None else controller.name,
    )


def _windows(response: FloatArray, impacts: Sequence[MeasuredImpact]) -> tuple[tuple[int, int], ...]:
    """Return the samples from each impact until its response has decayed, or until the next impact."""
    size = np.hypot(*response.T)
    windows = []
    for impact, end in zip(impacts, [*(b.start for b in impacts[1:]), len(size)], strict=True):
        part = size[impact.start : end]
        loud = np.flatnonzero(part > _DIED_OUT * part.max())
        windows.append((impact.start, impact.start + int(loud[-1]) + 1))
    return tuple(windows)


OVER = 0.95
"""A response has decayed when this share of its energy has passed."""
_QUIET = 50  # smallest number of samples between responses for an estimate of the noise


@dataclass(frozen=True)
class ImpactFigures:
    """Largest motion and decay time after the impacts of one recording: means, and standard deviations if measured.

    Attributes
    ----------
    peak_m, peak_std_m, peak_simulated_m : float
        Largest distance of the disc from its position before the impact [m]. The measured value contains sensor noise.
    decay_s, decay_std_s, decay_simulated_s : float
        Time from the impact until 95 % of the energy of the response has passed, without the energy of the noise [s].
        An amplitude that decays as exp(-d t) has lost 78 % by then.
    piezo_m, piezo_std_m, piezo_simulated_m : float
        Largest motion of a stack from its middle, ``|u| / 2`` [m]. The measured value contains the response of the
        controller to sensor noise. It is nan without the signal `u`.
    """

    peak_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, mean")]
    peak_std_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, standard deviation")]
    peak_simulated_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, simulated")]
    decay_s: Annotated[float, Stored("s", "time until the response is over, mean")]
    decay_std_s: Annotated[float, Stored("s", "time until the response is over, standard deviation")]
    decay_simulated_s: Annotated[float, Stored("s", "time until the response is over, simulated")]
    piezo_m: Annotated[float, Stored("m", "largest motion of a stack, mean")]
    piezo_std_m: Annotated[float, Stored("m", "largest motion of a stack, standard deviation")]
    piezo_simulated_m: Annotated[float, Stored("m", "largest motion of a stack, simulated")]


def impact_figures(
    recording: Recording,
    validation: ImpactValidation,
    actuators: LinearModel,
    controller: LinearModel | None = None,
) -> ImpactFigures:
    """Return largest motion and decay time after the impacts of a recording.

    Parameters
    ----------
    recording : Recording
        The validated recording.
    validation : ImpactValidation
        Its validation against the sampled loop.
    actuators : LinearModel
        Continuous actuators, from r to u.
    controller : LinearModel, optional
        Sampled controller, from p to r, with one sample of computation; open loop when not given.

    Returns
    -------
    ImpactFigures
    """
    v, h = validation, recording.sample_time
    motion = v.measured - v.stationary
    noise = _noise(motion, v)
    driven = np.zeros_like(v.simulated)
    if controller is not None:
        commands = controller.simulate(v.simulated)
        reference = np.vstack([np.zeros((1, 2)), commands[:-1]])  # the computation takes one sample
        driven = actuators.simulate(reference, h, intersample="zoh")
    moved, simulated = (np.hypot(*position.T) for position in (motion, v.simulated))
    piezos = np.full_like(driven, np.nan)
    if "u" in recording.signals:
        u, basis = recording.signal("u"), quiet_basis(recording, v.harmonics)
        piezos = u - basis @ np.linalg.lstsq(basis, u - driven, rcond=None)[0]
    responses = [slice(*window) for window in v.windows]
    peaks = [(moved[part].max(), simulated[part].max()) for part in responses]
    decays = [(_decay(moved[part], noise) * h, _decay(simulated[part], 0.0) * h) for part in responses]
    stacks = [(np.abs(piezos[part]).max() / 2, np.abs(driven[part]).max() / 2) for part in responses]
    return ImpactFigures(*_statistics(peaks), *_statistics(decays), *_statistics(stacks))


def _statistics(pairs: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Return mean and standard deviation of the measured values, and the mean of the simulated values."""
    measured, simulated = np.array(pairs).T
    spread = float(measured.std(ddof=1)) if len(measured) > 1 else float("nan")
    return float(measured.mean()), spread, float(simulated.mean())


def _noise(motion: FloatArray, validation: ImpactValidation) -> float:
    """Return the mean square of the disc's distance from its centre outside the responses; nan with too few samples."""
    quiet = np.ones(len(motion), dtype=bool)
    for start, stop in validation.windows:
        quiet[start:stop] = False
    return float((motion[quiet] ** 2).sum(axis=1).mean()) if quiet.sum() >= _QUIET else float("nan")


def _decay(distance: FloatArray, noise: float) -> float:
    """Return the number of samples until the share `OVER` of the response energy has passed."""
    energy = np.concatenate([[0.0], np.cumsum(distance**2 - noise)])
    if not energy[-1] > 0:
        return float("nan")
    after = int(np.argmax(energy >= OVER * energy[-1]))
    before = energy[after - 1]
    return after - 1 + float((OVER * energy[-1] - before) / (energy[after] - before))


Modes = tuple[tuple[float, float], ...]


def ringing_modes(
    plant: LinearModel,
    controller: LinearModel | None = None,
    *,
    count: int = 2,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> Modes:
    r"""Return the oscillatory modes that contribute most to the impulse responses from force to position.

    A mode with poles :math:`\lambda, \bar\lambda` and residue R contributes
    :math:`2 \mathrm{Re}(R e^{\lambda t})`, of energy about :math:`|R|^2 / |\mathrm{Re} \lambda|`. A bearing has two
    modes; a loop also has those of actuators and filters.

    Parameters
    ----------
    plant : LinearModel
        Continuous, from r (or u) to p.
    controller : LinearModel, optional
        Controller from p to r. A sampled controller gives the modes of the sampled loop, with the exact delays of the
        plant if it has any.
    count : int
        Number of modes.
    computation_s : float, optional
        Time from the sample of p to the change of r, sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    tuple of (frequency_hz, damping)
        Modes by rising frequency.

    Raises
    ------
    UsageError
        When models do not fit together.
    """
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    model = loop_of_impact(plant, controller, 0.0 if controller is None else controller.dt or 0.0, computation_s)
    E = np.vstack([E, np.zeros((model.n_states - len(E), E.shape[1]))])
    values, vectors = np.linalg.eig(model.A)
    residues = np.einsum("im,mj->mij", model.C @ vectors, np.linalg.pinv(vectors) @ E)
    lasting = np.abs(values) > 1e-9 if model.dt is not None else np.ones(len(values), dtype=bool)
    values, residues = values[lasting].astype(complex), residues[lasting]  # those of shift registers decay at once
    poles = values if model.dt is None else np.log(values) / model.dt
    keep = np.flatnonzero(one_of_each_pair(poles))
    energy = (np.abs(residues[keep]) ** 2).sum(axis=(1, 2)) / np.maximum(np.abs(poles[keep].real), 1e-9)
    chosen = poles[keep[np.argsort(-energy)[:count]]]
    return tuple((frequency, damping) for frequency, damping in oscillatory_modes(chosen).tolist())


@dataclass(frozen=True, eq=False)
class ImpactStudy(Brief, hdf5.InFile):
    """Expected and measured modes, and measured and simulated responses, at one operating point in one loop.

    Attributes
    ----------
    conditions : dict of str to float
        Operating point.
    loop : str
        ``"open"``, ``"closed"``, or the name of another closed loop.
    model, controller : str
        Names of model and controller; the latter is empty in open loop.
    expected : tuple of (frequency_hz, damping)
        Modes of the continuous model with first-order Pade delays, as in the paper.
    expected_sampled : tuple of (frequency_hz, damping)
        Modes of the sampled loop: sampled controller, one sample of computation, exact delays. Equal to `expected` in
        open loop.
    ringdown : RingDown
        Modes measured from the impacts.
    validations : tuple of ImpactValidation
        One for each recording, against the sampled loop.
    figures : tuple of ImpactFigures
        One for each recording: largest motion of disc and stacks, decay time.
    """

    conditions: Mapping[str, float]
    loop: str
    model: str
    controller: str
    expected: Annotated[Modes, Stored("Hz, 1", "modes of the model")]
    expected_sampled: Annotated[Modes, Stored("Hz, 1", "modes of the sampled loop", at="expected_running")]
    ringdown: RingDown
    validations: Annotated[tuple[ImpactValidation, ...], Stored(at="responses")]
    figures: tuple[ImpactFigures, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("impact", "make it again with `gbid impact`", 3)

    def document(self) -> Row:
        """Return modes and responses as plain values, for JSON."""
        ring = self.ringdown
        return {
            **self.conditions,
            "loop": self.loop,
            "model": self.model,
            "controller": self.controller,
            "status": ring.status,
            "success": ring.success,
            "notes": list(ring.notes),
            "impacts": ring.n_impacts,
            "lag_rates": ring.lag_rates.tolist(),
            "residual_rms": ring.residual_rms.tolist(),
            "modes": impact_mode_rows(self),
            "responses": response_rows(self),
        }

    def tables(self) -> list[Table]:
        """Return the tables of expected and obtained modes, of the responses, and of the motion after an impact."""
        where = f"{point_label(self.conditions['pressure_bar'], self.conditions['speed_rpm'])}: {self.loop}"
        modes = impact_mode_rows(self)
        rows: list[list[Entry]] = []
        for words, source, more in _SOURCES:
            if self.controller or source != "running_{}":
                frequencies = [formatted(row[f"{source.format('frequency')} [Hz]"], f".{1 + more}f") for row in modes]
                dampings = [formatted(row[source.format("damping")], f".{3 + more}f") for row in modes]
                rows.append([words, *frequencies, *dampings])
        columns = [Column(""), *(Column(f"ω{row['mode']}", "Hz", 4) for row in modes)]
        columns += [Column(f"ζ{row['mode']}", format=4) for row in modes]
        responses = response_rows(self)
        motion = [Column("recording")]
        moved: list[list[Entry]] = [[row["recording"]] for row in responses]
        for name, unit, heading in _MOTION:
            factor, shown = shown_unit(unit)
            motion += [Column(heading, shown, ".2f"), Column("std", format=".2f"), Column("simulated", format=".2f")]
            for row, cells in zip(responses, moved, strict=True):
                values = (row[f"{name}{suffix} [{unit}]"] for suffix in ("", "_std", "_simulated"))
                cells += [None if value is None else factor * value for value in values]
        notes = [f"note: {note}" for note in self.ringdown.notes]
        notes += [] if self.ringdown.success else [f"status: {self.ringdown.status}"]
        return [
            Table(f"{where}, natural frequencies and damping factors", columns, rows),
            keyed_table(f"{where}, measured against simulated responses, p = g_f G f", _RESPONSE, responses),
            Table(f"{where}, after an impact, mean over the impacts", motion, moved, ["", *notes] if notes else ()),
        ]


_SOURCES = (
    ("expected from model", "expected_{}", 0),
    ("expected, sampled loop", "running_{}", 0),
    ("obtained from the impacts", "obtained_{}", 2),
    ("  standard deviation", "obtained_{}_std", 2),
)
"""Rows of the table of modes: words, key in `impact_mode_rows`, and further decimals."""
_RESPONSE = {
    "recording": Column("recording"),
    "impacts": Column("impacts", format="d"),
    "force_scale [1/kg]": Column("g_f", "1/kg", ".4f"),
    "force_scale_std [1/kg]": Column("std", format=".4f"),
    "fit_along [%]": Column("fit along\nthe impact", "%", ".2f"),
    "fit_x [%]": Column("fit x", "%", ".2f"),
    "fit_y [%]": Column("fit y", "%", ".2f"),
}
"""Columns of the table of measured and simulated responses, by key."""
_MOTION = (("peak", "m", "disc up to\n"), ("decay", "s", "over after\n"), ("piezo", "m", "piezo up to\n"))
"""Figures of impacts in the rows of responses: name, unit and heading."""


def study_impacts(
    recordings: Sequence[Recording],
    model: LPVModel,
    controller: LinearModel | None = None,
    sampled: LinearModel | None = None,
    *,
    harmonics: int | None = None,
    lags: int | Literal["auto"] = "auto",
    loop: str | None = None,
) -> ImpactStudy:
    """Return a comparison of the modes fitted to the ring-downs of recordings with the modes of a model.

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings in one loop at one operating point, which their conditions give.
    model : LPVModel
        Model with actuators.
    controller, sampled : LinearModel, optional
        Controller during the recordings, continuous and sampled; open loop when not given.
    harmonics, lags
        See `fit_ringdown`.
    loop : str, optional
        Name of the loop; ``"open"`` or ``"closed"`` when not given.

    Returns
    -------
    ImpactStudy
    """
    point = {key: float(recordings[0].conditions[key]) for key in ("pressure_bar", "speed_rpm")}
    where = (point["pressure_bar"], point["speed_rpm"])
    plant, exact = model.plant_at(*where), exact_plant(model, *where)
    expected = ringing_modes(plant, controller)
    actuators = evaluate(PiezoPair(), model.actuators, plant.input_names, ("u_x", "u_y"))
    validations = tuple(validate_impact(rec, exact, sampled, harmonics=harmonics) for rec in recordings)
    return ImpactStudy(
        point,
        loop or ("open" if controller is None else "closed"),
        model.name,
        "" if controller is None else controller.name,
        expected,
        expected if sampled is None else ringing_modes(exact, sampled),
        fit_ringdown(recordings, harmonics=harmonics, lags=lags),
        validations,
        tuple(impact_figures(*pair, actuators, sampled) for pair in zip(recordings, validations, strict=True)),
    )


def impact_mode_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """Return rows of expected and identified modes, one for each mode; names have their units in brackets."""
    ring = study.ringdown
    return [
        {
            **study.conditions,
            "loop": study.loop,
            "mode": i + 1,
            "expected_frequency [Hz]": study.expected[i][0],
            "running_frequency [Hz]": study.expected_sampled[i][0],
            "obtained_frequency [Hz]": float(ring.frequency_hz[i]),
            "obtained_frequency_std [Hz]": float(ring.frequency_std[i]),
            "expected_damping": study.expected[i][1],
            "running_damping": study.expected_sampled[i][1],
            "obtained_damping": float(ring.damping[i]),
            "obtained_damping_std": float(ring.damping_std[i]),
            "lags": len(ring.lag_rates),
            "impacts": ring.n_impacts,
            "converged": ring.success,
        }
        for i in range(min(2, len(study.expected), len(study.expected_sampled)))
    ]


def response_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """Return rows of force scaling, fit percent, and motion of disc and piezos, one for each recording."""
    return [
        {
            "recording": v.recording,
            **study.conditions,
            "loop": study.loop,
            "axis": v.axis,
            "impacts": len(v.impacts),
            "force_scale [1/kg]": v.force_scale,
            "force_scale_std [1/kg]": v.force_scale_std,
            "fit_along [%]": v.along_percent,
            "fit_x [%]": float(v.fit_percent[0]),
            "fit_y [%]": float(v.fit_percent[1]),
            **{f"{name[: name.rindex('_')]} [{name[-1]}]": value for name, value in asdict(q).items()},
        }
        for v, q in zip(study.validations, study.figures, strict=True)
    ]
