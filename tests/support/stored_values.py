"""One small value of each kind of HDF5 file."""

import numpy as np

from gbid.characterise import PiezoCurve, StaticMap
from gbid.control.impact.measured import MeasuredImpact
from gbid.control.impact.ringdown import RingDown, RingDownStatus
from gbid.control.impact.study import ImpactFigures, ImpactStudy, ImpactValidation
from gbid.identify.table import FitTable
from gbid.lpv import load_model
from gbid.lpv.estimates import Estimates
from gbid.lpv.fit import LPVFit
from gbid.lpv.regression import OrderScore, Outlier
from gbid.prefilter.filtering import PrefilterReport
from gbid.prefilter.runout import RunoutMap
from gbid.recording import Recording
from gbid.validate.crossval import PointSummary, ValidationSummary, WorstPair


def numbers(*shape):
    return np.arange(1.0, 1.0 + np.prod(shape)).reshape(shape) / 7


def recording():
    return Recording(
        {"p": numbers(12, 2), "phi": numbers(12, 1)},
        2e-4,
        {"pressure_bar": 5.0, "speed_rpm": 6000.0},
        "run é",
        {"p": "m", "phi": "rad"},
        provenance={"source_file": "x.mat"},
    )


def static_map():
    whole = np.array([0, 0, 1])
    return StaticMap(
        gain=np.array([[1.5, np.nan], [0.1, np.nan]]),
        covariance=numbers(4, 4),
        offset=numbers(2, 2),
        dof=3,
        rms=numbers(2, 2),
        largest=numbers(2, 2),
        hysteresis=numbers(2, 2),
        hysteresis_std=numbers(2, 2),
        recording=whole,
        axis=whole - 2,
        direction=whole,
        command=numbers(3, 2),
        input_mean=numbers(3, 2),
        input_std=numbers(3, 2),
        output_mean=numbers(3, 2),
        output_std=numbers(3, 2),
        residual=numbers(3, 2),
        drift=numbers(3, 2),
        time=numbers(3, 2),
        input_names=("u_x", "u_y"),
        output_names=("p_x", "p_y"),
        units=("m", "m"),
        conditions={"pressure_bar": 6.0},
        sources=("a", "b"),
    )


def piezo_curve():
    return PiezoCurve(
        command=numbers(3),
        position=numbers(3),
        position_std=numbers(3),
        time=numbers(3),
        direction=np.array([0, 1, -1]),
        hysteresis=0.1,
        hysteresis_std=0.2,
        hysteresis_at=0.3,
        hysteresis_share=0.4,
        step=numbers(2),
        step_gain=numbers(2),
        creep=numbers(2),
        saturated=np.array([True, False]),
        uniformity=0.5,
        response_time=numbers(5),
        responses=numbers(5, 2),
        name="stack",
        channel="4",
        units=("V", "m"),
        notes=("a note",),
    )


def runout_map():
    return RunoutMap(
        method="harmonics",
        mean=numbers(2),
        orders=np.array([1.0, 2.0]),
        cosine=numbers(2, 2),
        sine=numbers(2, 2),
        angles=np.zeros(0),
        table=np.zeros((0, 2)),
        channels=("x", "y"),
        conditions={"pressure_bar": 5.0},
        sources=("still",),
        turns=12.5,
        rms_before=numbers(2),
        rms_after=numbers(2),
    )


def report():
    return PrefilterReport(
        name="run",
        channels={"u": ("x", "y"), "p": ("x", "y")},
        units={"u": "m", "p": "m"},
        rms_before={"u": numbers(2), "p": numbers(2)},
        rms_after={"u": numbers(2), "p": numbers(2)},
        offsets={"u": numbers(2), "p": numbers(2)},
        runout_share=numbers(2),
        harmonics=numbers(2, 2),
        spikes=(3, 4),
        median=3,
        map_sources=("still",),
    )


def impact_study():
    impacts = (MeasuredImpact(3, 9, 12.0, 45.0), MeasuredImpact(30, 39, 11.0, 46.0, 2))
    validation = ImpactValidation(
        force_scale=0.5,
        force_scale_std=0.01,
        fit_percent=numbers(2),
        along_percent=90.0,
        time=numbers(40),
        measured=numbers(40, 2),
        stationary=numbers(40, 2),
        simulated=numbers(40, 2),
        force=numbers(40, 2),
        windows=((3, 20), (30, 40)),
        impacts=impacts,
        harmonics=0,
        recording="hit",
        loop="closed",
    )
    ringdown = RingDown(
        frequency_hz=numbers(2),
        damping=numbers(2),
        frequency_std=numbers(2),
        damping_std=numbers(2),
        covariance=numbers(4, 4),
        stiffness=numbers(2, 2),
        damping_matrix=numbers(2, 2),
        lag_rates=numbers(1),
        residual_rms=numbers(2),
        n_impacts=2,
        recordings=("hit",),
        harmonics=0,
        status=RingDownStatus.CONVERGED,
    )
    return ImpactStudy(
        {"pressure_bar": 6.0, "speed_rpm": 0.0},
        "closed",
        "theisen2016",
        "paper",
        ((120.0, 0.2), (130.0, 0.3)),
        ((121.0, 0.2), (131.0, 0.3)),
        ringdown,
        (validation,),
        (ImpactFigures(*numbers(9).tolist()),),
    )


def validation_summary():
    return ValidationSummary(
        n_pairs=4,
        n_models=2,
        n_recordings=2,
        output_names=("p_x", "p_y"),
        output_units=("m", "m"),
        mean=numbers(2),
        std=numbers(2),
        median=numbers(2),
        least=numbers(2),
        greatest=numbers(2),
        edges=numbers(2, 4),
        counts=np.array([[1, 2, 1], [0, 4, 0]]),
        below=np.array([0, 1]),
        infinity_norm_mean=numbers(2),
        infinity_norm_max=numbers(2),
        worst=(WorstPair("a", "b", "p_x", 80.0, 1e-6),),
        points=(
            PointSummary(3.0, 0.0, 2, numbers(2), numbers(2), numbers(2)),
            PointSummary(np.nan, np.nan, 2, numbers(2), numbers(2), numbers(2)),
        ),
        failed=("a on c: not there",),
    )


def fit_table():
    return FitTable(
        fit=np.array(["bearing", "bearing"]),
        model=np.array(["run1", "run é"]),
        structure=np.array(["rotor_bearing", ""]),
        recordings=(("run1",), ()),
        pressure_bar=np.array([6.0, np.nan]),
        speed_rpm=np.array([0.0, np.nan]),
        parameter_names=("k_xx", "tau_x", "d"),
        units=("N/(kg m)", "s", ""),
        values=numbers(2, 3),
        std=numbers(2, 3),
        covariance=numbers(2, 3, 3),
        mode_frequency_hz=numbers(2, 1),
        mode_frequency_std_hz=numbers(2, 1),
        mode_damping=numbers(2, 1),
        mode_damping_std=numbers(2, 1),
        gain_names=("u_x to p_x",),
        static_gain=numbers(2, 1),
        static_gain_std=numbers(2, 1),
        output_names=("p_x", "p_y"),
        fit_percent=numbers(2, 2),
        success=np.array([True, False]),
        status=np.array(["converged", "failed: a dead sensor"]),
        notes=(("one", "two"), ()),
        iterations=np.array([12, 0]),
        wall_time_s=numbers(2),
    )


def lpv_fit():
    estimates = Estimates(("a", "b"), numbers(2, 2), numbers(2, 14), numbers(2, 14, 14), ("c: not there",))
    return LPVFit(
        load_model("theisen2016"),
        numbers(84, 84),
        numbers(14, 14),
        estimates,
        (Outlier("a", "k_xx", 0.1, 4.0),),
        (OrderScore(0, numbers(14), 1.0), OrderScore(1, np.full(14, np.nan), np.nan, "too few points")),
        numbers(14),
        {"method": "two steps"},
        notes=("a note",),
    )
