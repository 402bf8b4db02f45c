"""One small value of each kind of HDF5 file, made from the types of its fields."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from gbid.control.impact.study import ImpactStudy
from gbid.core.hdf5 import Stored
from gbid.identify.table import FitTable
from gbid.lpv import load_model
from gbid.lpv.estimates import Estimates
from gbid.lpv.fit import LPVFit
from gbid.lpv.regression import OrderScore, Outlier
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.prefilter.filtering import PrefilterFile, PrefilterReport
from gbid.prefilter.runout import RunoutMap
from gbid.recording import Recording
from gbid.validate.crossval import ValidationSummary

PLAIN: dict[Any, Any] = {float: 0.5, int: 3, bool: True, str: "run é"}


def numbers(*shape):
    return np.arange(1.0, 1.0 + np.prod(shape)).reshape(shape) / 7


def small(kind, **given):
    """Value of a dataclass whose fields are small, apart from those given."""
    types = get_type_hints(kind, include_extras=True)
    return kind(**{f.name: value_of(types[f.name]) for f in fields(kind) if f.name not in given}, **given)


def value_of(kind, shape=()):
    """Value of a type; the dimensions that have a word and no number have two entries."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        words = next(each.shape for each in parts if isinstance(each, Stored)).split()
        return value_of(parts[0], tuple(int(word) if word.isdigit() else 2 for word in words))
    if origin is Literal:
        return parts[0]
    if origin in (Union, UnionType):
        return value_of(next(each for each in parts if each is not NoneType), shape)
    if origin is np.ndarray:
        return numbers(*shape).astype(get_args(parts[1])[0])
    if origin is Mapping:
        return {"pressure_bar" if parts[1] is float else "one": value_of(parts[1], shape)}
    if origin is tuple and parts[-1] is not Ellipsis:
        return tuple(map(value_of, parts))
    if origin is tuple:
        entries = range(shape[0] if shape else 2)
        return tuple(f"{i} é" if parts[0] is str else value_of(parts[0], shape[1:]) for i in entries)
    if is_dataclass(kind):
        return small(kind)
    if issubclass(kind, tuple):
        return kind(*map(value_of, get_type_hints(kind, include_extras=True).values()))
    return next(iter(kind)) if issubclass(kind, Enum) else PLAIN[kind]


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
    return small(StaticMap)


def piezo_curve():
    return small(PiezoCurve)


def prefilter_file():
    sizes = {"u": numbers(2), "p": numbers(2)}
    report = small(
        PrefilterReport,
        channels={"u": ("x", "y"), "p": ("x", "y")},
        units={"u": "m", "p": "m"},
        rms_before=sizes,
        rms_after=sizes,
        offsets=sizes,
        spike_samples=(),
    )
    return PrefilterFile(small(RunoutMap, method="harmonics"), (report,))


def impact_study():
    return small(ImpactStudy)


def validation_summary():
    return small(ValidationSummary)


def fit_table():
    return small(FitTable)


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
