"""Sensitivities of the predictions, sample by sample, by parameters and initial states."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.kernel.block_sums import Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.kernel_protocol import Kernel
from gbid.identify.kernel.sweep import Linked
from gbid.identify.predictor import PredictorValues


class RecordSensitivities(NamedTuple):
    """Errors of a record, and the sensitivities of its predictions.

    Attributes
    ----------
    columns : (n_columns,) integer array
        Unknowns on which the record depends, among all parameters and, after them, the initial states of all records.
    psi : (n_y, n_columns, n_samples) array
        Derivatives of the predictions; zero for samples that are left out.
    errors : (n_samples, n_y) array
        Prediction errors; zero for samples that are left out.
    counted : (n_samples,) boolean array
        Whether a sample is in the cost.
    feedback : (PredictorValues, (n_p,) integer array) or None
        Predictor that feeds measured outputs back, and its parameters among `columns`; None without feedback.
    """

    columns: IntArray
    psi: FloatArray
    errors: FloatArray
    counted: BoolArray
    feedback: tuple[PredictorValues, IntArray] | None = None


class SegmentSensitivities(NamedTuple):
    """The same for one segment, by the parameters of its predictor and, after them, the state at its start."""

    psi: FloatArray
    errors: FloatArray
    counted: BoolArray


def of_segment(
    kernel: Kernel, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, segment: int
) -> SegmentSensitivities:
    """Return the sensitivities of one segment of a part.

    Parameters
    ----------
    kernel : Kernel
        Kernel of the part.
    v
        Its predictor at the parameters.
    blocks : Blocks
        The segments of the part, each as one window.
    prediction : Prediction
        States and errors from the starts of the blocks.
    linked : Linked
        Sensitivities of the starts of the blocks.
    segment : int
        Position of the segment.

    Returns
    -------
    SegmentSensitivities
        Sensitivities, errors, and which samples count.
    """
    first = int(blocks.window_first[segment])
    stop = first + int(blocks.window_size[segment])
    n_y = blocks.y.shape[2]
    psi = kernel.sensitivities(v, blocks, prediction, linked, slice(first, stop))
    n_samples = int(blocks.size[first:stop].sum())
    return SegmentSensitivities(
        psi.reshape(n_y, psi.shape[0] // n_y, -1)[:, :, :n_samples],
        blocks.by_segment(prediction.errors)[segment],
        blocks.by_segment(blocks.used[:, :, None])[segment][:, 0] > 0,
    )


def tied_sensitivities(own: SegmentSensitivities, tie: FloatArray | None) -> SegmentSensitivities:
    """Return sensitivities by the parameters to which those of the predictor are tied; see `RecordGroup`."""
    if tie is None:
        return own
    n = len(tie)
    by_theta = np.einsum("op,yot->ypt", tie, own.psi[:, :n], optimize=True)
    return own._replace(psi=np.concatenate([by_theta, own.psi[:, n:]], axis=1))


def tied_values(v: PredictorValues, tie: FloatArray | None) -> PredictorValues:
    """Return a predictor with derivatives by the parameters to which its own are tied."""
    if tie is None:
        return v
    dF, dG, dC, dH = (np.tensordot(tie.T, slope, 1) for slope in (v.dF, v.dG, v.dC, v.dH))
    return v._replace(dF=dF, dG=dG, dC=dC, dH=dH)


def joined_segments(
    segments: list[tuple[SegmentSensitivities, IntArray, FloatArray]],
    feedback: tuple[PredictorValues, IntArray] | None,
) -> RecordSensitivities:
    """Return the sensitivities of a record from those of its segments, in the order of time.

    Parameters
    ----------
    segments : list of (SegmentSensitivities, (n_p,) integer array, (n, n_all) array)
        Each segment with the positions of its parameters, and the sensitivity of its start by all unknowns.
    feedback : (PredictorValues, (n_p,) integer array), optional
        Predictor with feedback of measured outputs, and the positions of its parameters.

    Returns
    -------
    RecordSensitivities
        Sensitivities by the unknowns that matter.
    """
    if len(segments) == 1:  # its start is the initial state itself
        own, index, start = segments[0]
        columns = np.concatenate([index, np.flatnonzero(start.any(axis=0))])
        among = None if feedback is None else (feedback[0], np.arange(len(index)))
        return RecordSensitivities(columns, own.psi, own.errors, own.counted, among)
    n_all = segments[0][2].shape[1]
    touched = np.zeros(n_all, bool)
    for _, index, start in segments:
        touched[index] = True
        touched |= start.any(axis=0)
    columns = np.flatnonzero(touched)
    place = np.cumsum(touched) - 1
    stretches = []
    for own, index, start in segments:
        n_p = len(index)
        psi = start[:, columns].T @ own.psi[:, n_p:]
        psi[:, place[index]] += own.psi[:, :n_p]
        stretches.append(psi)
    return RecordSensitivities(
        columns,
        np.concatenate(stretches, axis=2),
        np.concatenate([own.errors for own, _, _ in segments]),
        np.concatenate([own.counted for own, _, _ in segments]),
        None if feedback is None else (feedback[0], place[feedback[1]]),
    )
