"""Cross-validation of one model on one recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from gbid.errors import DataError
from gbid.experiment.experiment import Experiment
from gbid.experiment.recordings import FOLDER as RECORDINGS
from gbid.experiment.run.inputs import check_made
from gbid.experiment.run.job import Job
from gbid.experiment.stages.crossval.plan import figure_pairs
from gbid.experiment.stages.fit.stage import fit_path, load_made_fit, model_key, samples_of
from gbid.experiment.stages.fit.structures import make_structure
from gbid.experiment.stages.prefilter.stage import FOLDER as PREFILTERED
from gbid.experiment.stages.prefilter.stage import fit_input_key, load_fit_input
from gbid.identify import FitResult, MeasuredResponse, measured_response
from gbid.recording import Recording
from gbid.structure import model_of
from gbid.validate import ResidualTest, Validation, check_residuals, cross_validate

_LAGS = 50  # largest lag of the residual test


def validate_pair(job: Job, name: str, model: str, recording: str) -> Validation:
    """Return the scores of one model of a fit on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    result, data = _model_and_recording(job, name, model, recording)
    return cross_validate(result, data, left_out_of(job, name, data))


def residuals_of_pair(job: Job, name: str, model: str, recording: str) -> ResidualTest:
    """Return the residual tests of one model of a fit on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    return residuals_on(job, name, *_model_and_recording(job, name, model, recording))


def bode_of_pair(job: Job, name: str, model: str, recording: str) -> tuple[FitResult, MeasuredResponse]:
    """Return one model of a fit, and the frequency response measured in one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    result, data = _model_and_recording(job, name, model, recording)
    options = result.options
    return result, measured_response(data, options.inputs, options.outputs, intersample=options.intersample)


def residuals_on(job: Job, name: str, result: FitResult, data: Recording) -> ResidualTest:
    """Return the residual tests of a loaded model on a loaded recording."""
    left_out = left_out_of(job, name, data)
    edges = [0, *sorted(edge for stretch in left_out for edge in stretch), data.n_samples]
    longest = max(stop - start for start, stop in zip(edges[::2], edges[1::2], strict=True))
    return check_residuals(result, data, lags=max(1, min(_LAGS, longest // 4)), left_out=left_out)


def left_out_of(job: Job, name: str, data: Recording) -> list[tuple[int, int]]:
    """Return the samples of a recording that the experiment leaves out of a fit, as (first, stop) pairs.

    Raises
    ------
    DataError
        When a stretch lies beyond the end of the recording.
    """
    stretches = job.experiment.spec.fits[name].left_out.get(data.name, ())
    return [samples_of(data, *stretch) for stretch in stretches]


def pair_keys(job: Job, name: str, model: str, recording: str) -> list[str]:
    """Return the content keys of a model and of the recording on which it is validated."""
    return [model_key(job.experiment, name, model), data_key(job.experiment, name, recording)]


def data_key(experiment: Experiment, name: str, recording: str) -> str:
    """Return the content key of a recording for validation, with the stretches that are left out."""
    key = fit_input_key(experiment, experiment.recordings[recording])
    left_out = experiment.spec.fits[name].left_out.get(recording)
    return f"{key} without {left_out}" if left_out else key


def check_model(job: Job, name: str, model: str) -> None:
    """Refuse a model that is missing or was made from other settings; the file is not read in full.

    Raises
    ------
    DataError
        When the model is missing or was made from other settings.
    """
    check_made(fit_path(job, name, model), model_key(job.experiment, name, model), "gbid fit")


def check_fit_input(job: Job, recording: str) -> None:
    """Refuse a recording that is missing or was made from other settings; the file is not read in full.

    Raises
    ------
    DataError
        When the recording is missing or was made from other settings.
    """
    planned = job.experiment.recordings[recording]
    raw = job.experiment.spec.prefilter is None
    verb = "gbid fit" if not raw else "gbid import" if planned.imported else "gbid rig"
    check_made(job.path(RECORDINGS if raw else PREFILTERED, recording), fit_input_key(job.experiment, planned), verb)


def drawn_pairs(job: Job) -> Iterable[tuple[str, str, str]]:
    """Yield fit, model and recording of each figure of the experiment."""
    for name in job.experiment.spec.figures:
        for model, recording in figure_pairs(job.experiment, name):
            yield name, model, recording


def with_local(job: Job, name: str, result: FitResult, recording: str) -> FitResult:
    """Return a fit result with the local parameters of a recording, or those of its operating point.

    Raises
    ------
    DataError
        When the result has no local parameters for the recording.
    """
    if not result.local_names:
        return result
    known, scopes = job.experiment.recordings, job.experiment.spec.fits[name].local
    alike = [recording] if recording in result.recordings else []
    if not alike and all(scope == "operating_point" for scope in scopes.values()):
        alike = [other for other in result.recordings if known[other].point == known[recording].point]
    if not alike:
        raise DataError(
            f"fit {name!r} has parameters local to a recording or operating point ({', '.join(scopes)}); "
            f"there are none for recording {recording!r}; validate it on one of its own"
        )
    structure, found = make_structure(job.experiment, name), result.parameters_of(alike[0])
    own = {q.name: found[q.name] for q in structure.parameters}
    model = model_of(structure, own, result.model.input_names, result.model.output_names)
    first, other = (result.local_names.get(name, {}) for name in (result.recordings[0], alike[0]))
    return replace(result, model=model, model_slopes=result.model_slopes if first == other else None)


def _model_and_recording(job: Job, name: str, model: str, recording: str) -> tuple[FitResult, Recording]:
    result = load_made_fit(job, name, model)
    data = load_fit_input(job, job.experiment.recordings[recording])
    return with_local(job, name, result, recording), data
