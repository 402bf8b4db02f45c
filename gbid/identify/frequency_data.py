"""Frequency responses as data of a fit: given, read from files, or measured from recordings; delay estimates."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from gbid.core.apart import read_apart
from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.figures import Pictured
from gbid.core.option_types import Positive, checks_arguments
from gbid.core.tables import Column, Table
from gbid.discretise.exact import check_holds, hold_response
from gbid.identify.data import same_columns, select
from gbid.identify.uncertainty.curves import ChannelCurves
from gbid.recording import Recording
from gbid.recording.columns import name_and_unit
from gbid.recording.formats import format_of_ending
from gbid.recording.readers import PairResponse
from gbid.recording.text_files import read_text
from gbid.structure.linear import as_names


@dataclass(frozen=True, eq=False)
class FrequencyData(ChannelCurves, Pictured):
    """Frequency response with standard deviations, as data of a fit.

    `gbid.fit` takes it in the place of a recording, alone or together with recordings.

    Parameters
    ----------
    frequencies : (n,) array
        Frequencies above zero [Hz], ascending.
    responses : (n, n_outputs, n_inputs) or (n,) complex array
        Responses in units of the output per unit of the input, of continuous time. nan is what was not measured.
    std : array, optional
        Standard deviation of real and imaginary part each, which is that of the magnitude: in the shape of the
        responses, or one number.
    coherence : array, optional
        In place of `std`: coherence from 0 to 1 in the shape of the responses, or (n, n_outputs).
    inputs, outputs : str or sequence of str
        Names of the channels, such as ``u_x``; a fit looks for those of its structure by name where it has several.
    averages : float, optional
        Number of independent averages of the spectra, which a standard deviation from the coherence needs.
    correlation : sequence of float
        Correlation of the errors of responses that are one, two, ... frequencies apart; those of spectra of Hann
        windows are ``(4 / 9, 1 / 36)``.
    name : str
        Name of the data.
    of_loop : bool
        Whether they are quotients of responses of a loop, whose errors are correlated in a way that `std` does not
        contain; see `channels`. A fit then takes the robust standard deviations.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    response : (n, n_outputs, n_inputs) complex array
        Frequency response.
    std : (n, n_outputs, n_inputs) array
        Standard deviation of its real and of its imaginary part.
    input_names, output_names : tuple of str
        Names of the channels.

    Raises
    ------
    UsageError
        When shapes do not match, frequencies do not ascend, or there are no standard deviations.

    Notes
    -----
    The standard deviation from the coherence g is ``|G| sqrt((1 - g) / (2 g averages))`` (Bendat and Piersol, Random
    Data, 2010, Sec. 9.2, for the coherence without a root).
    """

    _title: ClassVar[str] = "frequency response"
    frequency_hz: FloatArray
    response: ComplexArray
    std: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    name: str = "response"
    correlation: tuple[float, ...] = ()
    of_loop: bool = False

    drawn_by = "plot_bode"

    @checks_arguments
    def __init__(
        self,
        frequencies: npt.ArrayLike,
        responses: npt.ArrayLike,
        std: npt.ArrayLike | None = None,
        coherence: npt.ArrayLike | None = None,
        inputs: str | Sequence[str] = "u",
        outputs: str | Sequence[str] = "y",
        *,
        averages: float | None = None,
        correlation: Sequence[float] = (),
        name: str = "response",
        of_loop: bool = False,
    ) -> None:
        f = np.atleast_1d(np.asarray(frequencies, float))
        input_names, output_names = as_names(inputs), as_names(outputs)
        shape = (len(f), len(output_names), len(input_names))
        G = np.asarray(responses, complex)
        if G.size != np.prod(shape) or G.ndim == 0 or G.shape[0] != shape[0]:
            raise UsageError(
                f"responses of {name!r} have the shape {G.shape}; {len(f)} frequencies, {shape[1]} outputs and "
                f"{shape[2]} inputs need {shape}"
            )
        G = G.reshape(shape)
        if not (len(f) and np.isfinite(f).all() and f[0] > 0 and (np.diff(f) > 0).all()):
            raise UsageError(f"frequencies of {name!r} must be above zero and ascend")
        if (std is None) == (coherence is None):
            raise UsageError(f"{name!r}: give std, or coherence with averages: a fit weights responses by their errors")
        if std is not None:
            sigma = np.array(np.broadcast_to(_shaped(std, shape, "std"), shape), float)
        elif averages is None or not averages > 0:
            raise UsageError(f"{name!r}: coherence needs averages, the number of independent averages")
        else:
            squared = np.broadcast_to(_shaped(coherence, shape, "coherence"), shape)
            if not ((squared >= 0) & (squared <= 1) | np.isnan(squared)).all():
                raise UsageError(f"coherence of {name!r} must lie between 0 and 1")
            with np.errstate(divide="ignore", invalid="ignore"):
                sigma = np.abs(G) * np.sqrt((1 - squared) / (2 * squared * averages))
        if (sigma[np.isfinite(sigma)] < 0).any() or not (sigma[np.isfinite(sigma) & np.isfinite(G)] > 0).any():
            raise UsageError(f"std of {name!r} must be positive")
        made = {"frequency_hz": f, "response": G, "std": sigma, "name": name, "correlation": tuple(correlation)}
        made |= {"of_loop": of_loop, "input_names": input_names, "output_names": output_names}
        for key, value in made.items():
            object.__setattr__(self, key, value)

    def _brief(self) -> Description:
        about = f"{self.name}, {len(self.frequency_hz)} frequencies"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    def table(self) -> Table:
        """Return a table with a row for each output, input and frequency; `read` reads its CSV file."""
        numbers = self._numbers()
        columns = [Column("output"), Column("input"), *(Column(name, format=8) for name in ("frequency_hz", *numbers))]
        return Table(self._title, columns, self._rows(self.frequency_hz, *numbers.values()))

    def _numbers(self) -> dict[str, FloatArray]:
        """Return the value columns of the table (all but the frequency), each (n, n_outputs, n_inputs)."""
        G = self.response
        return {"magnitude": np.abs(G), "magnitude_std": self.std, "phase_deg": np.degrees(np.angle(G))}

    @classmethod
    def read(cls, path: str | Path, *, averages: float | None = None, std: float | None = None) -> FrequencyData:
        """Return the frequency response in a CSV file or a universal file.

        Parameters
        ----------
        path : str or path
            CSV file with a row for each output, input and frequency, and a header: ``frequency_hz``, then ``magnitude``
            or ``magnitude_db`` and ``phase_deg`` (also ``Frequency (Hz)``, ``Magnitude (dB)``, ``Phase (°)``), or
            ``real`` and ``imaginary``; ``magnitude_std``, ``std`` or ``coherence``; ``output``
            and ``input`` with the names of the channels where there are several. Or a universal file (``.uff``,
            ``.unv``, ``.uf``) with frequency responses in sets 58, and perhaps their coherence, or in sets 55. A value
            at 0 Hz is left out.
        averages : float, optional
            Number of independent averages, for the coherence.
        std : float, optional
            Standard deviation of all responses, in place of what the file says.

        Returns
        -------
        FrequencyData

        Raises
        ------
        DataError
            When the file cannot be read, or lacks a column or a value.
        UsageError
            When neither the file nor the caller gives standard deviations.
        """
        path = Path(path)
        kind = format_of_ending(path.suffix.lower())
        read, more = (kind.responses, []) if kind and kind.responses else (_of_csv, [std is None])
        try:
            packages = kind.packages if kind else ()
            pairs, coherent = read_apart(read, path, *more, types=(PairResponse,), packages=packages)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
        if not pairs:
            raise DataError(f"{path}: has the names of the columns, but no rows")
        outputs, inputs = (list(dict.fromkeys(pair[k] for pair in pairs)) for k in (0, 1))
        f = np.unique(np.concatenate([each.frequency_hz for each in pairs.values()]))
        f = f[f != 0]
        response = np.full((len(f), len(outputs), len(inputs)), np.nan, complex)
        size = np.full(response.shape, np.nan)
        for (output, source), each in pairs.items():
            used = each.frequency_hz != 0
            place = np.searchsorted(f, each.frequency_hz[used]), outputs.index(output), inputs.index(source)
            response[place] = each.values[used]
            size[place] = np.nan if each.quality is None else each.quality[used]
        quality: dict[str, Any] = {"coherence" if coherent else "std": size}
        if std is not None:
            quality = {"std": std}
        elif next(iter(pairs.values())).quality is None:
            raise UsageError(
                f"{path}: has no coherence, and a fit weights responses by their errors: give std, the standard "
                "deviation of real and imaginary part"
            )
        try:
            return cls(f, response, inputs=inputs, outputs=outputs, averages=averages, name=path.stem, **quality)
        except GbidError as error:
            raise type(error)(f"{path}: {error}") from None

    @classmethod
    def from_control(
        cls,
        data: Any,
        std: npt.ArrayLike | None = None,
        coherence: npt.ArrayLike | None = None,
        *,
        averages: float | None = None,
        correlation: Sequence[float] = (),
        name: str | None = None,
    ) -> FrequencyData:
        """Return the data of a `FrequencyResponseData` (FRD) object of python-control.

        Parameters
        ----------
        data : control.FRD
            Responses (n_outputs, n_inputs, n) over frequencies [rad/s], in any order, with labels of the channels.
        std, coherence, averages, correlation, name
            As for `FrequencyData`; standard deviations (n, n_outputs, n_inputs) are in the order of the frequencies.

        Raises
        ------
        UsageError
            When it is no such object, or there are no standard deviations.
        """
        labels: list[Any] = [getattr(data, k, None) for k in ("omega", "frdata", "input_labels", "output_labels")]
        if any(each is None for each in labels):
            raise UsageError(
                f"a {type(data).__name__} is no frequency response of python-control; give control.frd(...), or "
                "arrays to FrequencyData"
            )
        omega, values, inputs, outputs = labels
        order = np.argsort(omega)
        order = order[np.asarray(omega)[order] != 0]
        title = name or str(getattr(data, "name", "response"))
        sigma, squared = (
            each if each is None or np.ndim(each) == 0 else np.asarray(each, float)[order] for each in (std, coherence)
        )
        responses = np.moveaxis(np.asarray(values), -1, 0)[order]
        frequencies = np.asarray(omega)[order] / (2 * np.pi)
        options: dict[str, Any] = {"averages": averages, "correlation": correlation, "name": title}
        return cls(frequencies, responses, sigma, squared, inputs, outputs, **options)

    def channels(
        self, inputs: str | Sequence[str], outputs: str | Sequence[str], *, reference: str | Sequence[str] = ()
    ) -> FrequencyData:
        """Return the responses between given channels, in the given order.

        Parameters
        ----------
        inputs, outputs : str or sequence of str
            Names of a structure: channels (``"u_x"``, ``"u.x"``) or signals (``"u"``: all its channels).
        reference : str or sequence of str
            Signals that excite a closed loop from outside, as many as inputs. The data are then responses of inputs
            and outputs to them, and the result is the plant, ``G_yr G_ur^-1``. It may be unstable.

        Raises
        ------
        DataError
            When a channel is missing, or the references do not move the inputs independently.
        UsageError
            When there are not as many references as inputs.

        Notes
        -----
        To first order the error of ``G = G_yr G_ur^-1`` is ``(E_yr - G E_ur) G_ur^-1``. Its standard deviation takes
        the errors of all responses as independent.
        """
        if reference:
            return self._plant(as_names(inputs), as_names(outputs), as_names(reference))
        if driven := [each for each in as_names(inputs) if each.replace(".", "_") in self.output_names]:
            raise DataError(
                f"{driven[0]!r} is an output of the frequency response {self.name!r} to {', '.join(self.input_names)}; "
                "name the excitation of this loop (reference=...)"
            )
        rows, columns = (
            _places(names, as_names(wanted), self.name)
            for names, wanted in ((self.output_names, outputs), (self.input_names, inputs))
        )
        picked = np.ix_(range(len(self.frequency_hz)), rows, columns)
        names = [self.input_names[i] for i in columns], [self.output_names[i] for i in rows]
        return FrequencyData(
            self.frequency_hz,
            self.response[picked],
            self.std[picked],
            None,
            *names,
            correlation=self.correlation,
            name=self.name,
            of_loop=self.of_loop,
        )

    def _plant(self, inputs: Sequence[str], outputs: Sequence[str], reference: Sequence[str]) -> FrequencyData:
        to_u, to_y = self.channels(reference, inputs), self.channels(reference, outputs)
        n_u, n_r = to_u.response.shape[1:]
        if n_u != n_r:
            raise UsageError(f"frequency response {self.name!r}: {n_r} references for {n_u} inputs; give as many")
        known = np.isfinite(to_u.response).all(axis=(1, 2))
        try:
            inverse = np.linalg.inv(to_u.response[known])
        except np.linalg.LinAlgError:
            problem = f"{', '.join(reference)} do not move {', '.join(inputs)} independently"
            raise DataError(f"frequency response {self.name!r}: {problem}") from None
        G = to_y.response[known] @ inverse
        variance = (to_y.std[known] ** 2 + np.abs(G) ** 2 @ to_u.std[known] ** 2) @ np.abs(inverse) ** 2
        names = to_u.output_names, to_y.output_names
        options: dict[str, Any] = {"correlation": self.correlation, "name": self.name, "of_loop": True}
        return FrequencyData(self.frequency_hz[known], G, np.sqrt(variance), None, *names, **options)


_SUFFIX = {"Hz": "_hz", "dB": "_db", "deg": "_deg", "°": "_deg"}
"""Ends of the names of columns by their units, so that ``Phase [°]`` is ``phase_deg``; others are not looked at."""
_HEADER_LINES = 200  # within which the header line is looked for


def _names(line: str) -> tuple[list[str], str]:
    """Return the column names in a line of a CSV file, and the delimiter."""
    delimiter = max(",;\t", key=line.count)
    headings = [name_and_unit(cell.strip()) for cell in next(csv.reader([line], delimiter=delimiter), [])]
    return [name.lower() + _SUFFIX.get(unit or "", "") for name, unit in headings], delimiter


def _of_csv(path: Path, needs_spread: bool) -> tuple[dict[tuple[str, str], PairResponse], bool]:
    """Return the responses in a CSV file by output and input, and whether their quality is given as coherence."""
    try:
        return _of_text(path, read_text(path).text.splitlines(), needs_spread)
    except DataError:
        raise
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: is no table of a frequency response: {error}") from None


def _of_text(path: Path, lines: Sequence[str], needs_spread: bool) -> tuple[dict[tuple[str, str], PairResponse], bool]:
    """Return the responses in the lines of a CSV file; see `_of_csv`.

    The header line is the first one with the frequency. Numbers have a decimal comma where no comma is between them.
    """
    named = enumerate(_names(line) for line in lines[:_HEADER_LINES])
    at, (names, delimiter) = next(
        (each for each in named if "frequency_hz" in each[1][0]), (0, _names("".join(lines[:1])))
    )
    lines = lines[at:]
    rows = list(csv.DictReader(lines[1:], names, delimiter=delimiter))
    given = set(names)
    scale = next((key for key in ("magnitude", "magnitude_db") if key in given), "")
    polar = bool(scale) and "phase_deg" in given
    spread = next((key for key in ("magnitude_std", "std", "coherence") if key in given), None)
    lacks_spread = needs_spread and spread is None
    if "frequency_hz" not in given or not (polar or {"real", "imaginary"} <= given) or lacks_spread:
        missing = "magnitude_std, std or coherence, or std given with the file" if lacks_spread else "no more"
        raise DataError(
            f"{path}: needs the columns frequency_hz, magnitude (or magnitude_db) and phase_deg, or real and "
            f"imaginary, and {missing}; it has {', '.join(sorted(given)) or 'nothing'}"
        )
    keys = ["frequency_hz", *((scale, "phase_deg") if polar else ("real", "imaginary"))]
    keys += [] if spread is None else [spread]
    numbers: dict[tuple[str, str], list[list[float]]] = {}
    for row in rows:
        cells = [row[k] if delimiter == "," else row[k].replace(",", ".") for k in keys]
        numbers.setdefault((row.get("output", "y"), row.get("input", "u")), []).append([float(cell) for cell in cells])
    pairs = {}
    for pair, values in numbers.items():
        f, a, b, *quality = np.array(values).T
        a = 10 ** (a / 20) if scale == "magnitude_db" and polar else a
        response = a * np.exp(1j * np.radians(b)) if polar else a + 1j * b
        pairs[pair] = PairResponse(f, response, quality[0] if quality else None)
    return pairs, spread == "coherence"


def _shaped(values: Any, shape: tuple[int, ...], what: str) -> FloatArray:
    """Return values broadcast to (n, n_outputs, n_inputs); values (n,) and (n, n_outputs) hold for all inputs."""
    array = np.asarray(values, float)
    if 0 < array.ndim < len(shape):
        array = array.reshape(*array.shape, *[1] * (len(shape) - array.ndim))
    try:
        np.broadcast_shapes(array.shape, shape)
    except ValueError:
        raise UsageError(f"{what} has the shape {array.shape}; responses have {shape}") from None
    return array


def _places(names: Sequence[str], wanted: Sequence[str], source: str) -> list[int]:
    """Return the positions of channels, or of all channels of a signal, in a list of names."""
    if len(names) == len(wanted) == 1:
        return [0]
    places = list[int]()
    for each in wanted:
        meant = each.replace(".", "_")
        matching = [i for i, name in enumerate(names) if name == meant or name.startswith(f"{meant}_")]
        if not matching:
            raise DataError(f"frequency response {source!r} has no channel {each!r}; it has {', '.join(names)}")
        places += matching
    return places


# ---- Frequency response measured from recordings: averaged spectra, coherence and standard deviations.

_SEGMENTS = 12  # usual number of segments of the shortest recording, which overlap by half
HANN = (4 / 9, 1 / 36)
"""Correlation of the errors of responses one and two frequencies apart: those of Hann spectra, (2/3)^2 and (1/6)^2."""
_CORRELATED = 1 / 18  # twice the squared correlation of the spectra of neighbouring Hann segments (Welch, 1967)


@dataclass(frozen=True, eq=False)
class MeasuredResponse(FrequencyData):
    """Frequency response measured from recordings without a model; `gbid.fit` accepts it as data.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    response : (n, n_outputs, n_inputs) complex array
        Estimated frequency response.
    std : (n, n_outputs, n_inputs) array
        Standard deviation of its magnitude, and of its phase times the magnitude.
    coherence : (n, n_outputs) array
        Part of the power of each output that the inputs explain (multiple coherence), from 0 to 1.
    input_names, output_names : tuple of str
        Names of the channels.
    name : str
        Name of the first recording.
    correlation : tuple of float
        Correlation of the errors of neighbouring frequencies; see `FrequencyData`.
    of_loop : bool
        See `FrequencyData`.
    averages : float
        Equivalent number of independent segments.
    """

    _title: ClassVar[str] = "measured frequency response"
    coherence: FloatArray = field(kw_only=True)
    averages: float = field(kw_only=True)

    def _brief(self) -> Description:
        about = f"{len(self.frequency_hz)} frequencies, {self.averages:.1f} averages"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    def _numbers(self) -> dict[str, FloatArray]:
        return {**super()._numbers(), "coherence": np.broadcast_to(self.coherence[..., None], self.std.shape)}


def measured_response(
    recordings: Recording | Sequence[Recording],
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    *,
    resolution_hz: Positive | None = None,
    intersample: str | Sequence[str] | None = "zoh",
    reference: str | Sequence[str] = (),
    period_s: float | None = None,
) -> MeasuredResponse:
    """Return the frequency response between signals of recordings, by averaged spectra (Welch).

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings with the same channels and sample time; their spectra are averaged.
    inputs, outputs : str or sequence of str
        Signals (``"p"``) or channels (``"p.x"``).
    resolution_hz : float, optional
        Distance of the frequencies [Hz]; by default that of about twelve segments in the shortest recording. A
        resonance narrower than two such distances is shown too low and too wide.
    intersample : {"zoh", "foh"}, sequence of these, or None
        Behaviour of each input between samples. Its effect is divided out, so that the response is that of the
        continuous-time model, as far as this has rolled off at half the sampling frequency. None leaves the response of
        the samples as it is.
    reference : str or sequence of str
        Signals that excite a closed loop from outside, as many as inputs. In a loop the inputs contain the noise of
        the outputs; the reference does not, and removes this bias.
    period_s : float, optional
        Period of a periodic excitation, such as a multisine [s]. Whole periods after the first, which has the
        transient, are transformed without a window: there is no leakage, and a light resonance is not widened. Each
        line needs as many recordings as inputs move at it; where there are fewer, the response is nan. The reference
        has no use then.

    Returns
    -------
    MeasuredResponse

    Raises
    ------
    DataError
        When a recording lacks a signal, sample times differ, recordings are too short for the resolution, or the inputs
        do not excite independently.
    UsageError
        When there are not as many reference channels as inputs, or the resolution is not positive.

    Notes
    -----
    With the spectral matrices S of Hann segments that overlap by half, ``H = S_yu S_uu^-1``, or
    ``H = S_yr S_ur^-1`` with a reference (Ljung, System Identification, Sec. 6.4; Pintelon and Schoukens, 2012,
    Sec. 2.6). The variance of an entry is ``(1 - coherence) S_yy [S_uu^-1] / averages`` for the complex value; with a
    reference ``S_ee [S_ur^-H S_rr S_ur^-1] / averages``, with the power of ``e = y - H u``. For periodic excitation it
    is that of the mean over the periods, whose noise is smoothed over neighbouring lines (Sec. 2.5).
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    u, input_names, _ = same_columns(several, as_names(inputs))
    y, output_names, _ = same_columns(several, as_names(outputs))
    r = [select(rec, as_names(reference))[0] for rec in several] if reference else u
    n_u, h = u[0].shape[1], several[0].sample_time
    if r[0].shape[1] != n_u:
        raise UsageError(f"reference has {r[0].shape[1]} channels for {n_u} inputs; give as many")
    names = tuple(input_names), tuple(output_names)
    if period_s is not None:
        f, response, std, coherence, averages = _of_periods(several, u, y, period_s)
    else:
        f, response, std, coherence, averages = _of_segments(several, u, y, r, resolution_hz)
    hold: ComplexArray = np.ones((len(f), 1, n_u), complex)
    if intersample is not None:
        hold = hold_response(f * h, check_holds(intersample, n_u))[:, None, :]
    return MeasuredResponse(
        f,
        np.asarray(response / hold, complex),
        std / np.abs(hold),
        *names,
        several[0].name,
        () if period_s is not None else HANN,
        coherence=coherence,
        averages=averages,
    )


_Estimate = tuple[FloatArray, ComplexArray, FloatArray, FloatArray, float]
"""Frequencies, response, standard deviations, coherence, and number of averages."""


def _of_segments(
    recordings: Sequence[Recording],
    u: Sequence[FloatArray],
    y: Sequence[FloatArray],
    r: Sequence[FloatArray],
    resolution_hz: float | None,
) -> _Estimate:
    """Return the frequency response from Hann windows that overlap by half."""
    n_u, n_y, closed = u[0].shape[1], y[0].shape[1], r is not u
    length = _segment_length(recordings, resolution_hz)
    joined = [np.hstack(parts) for parts in zip(u, y, r, strict=True)]
    S, count = _spectra(joined, length)
    at_u, at_y, at_r = slice(0, n_u), slice(n_u, n_u + n_y), slice(n_u + n_y, None)
    keep = slice(1, length // 2)
    f = np.asarray(np.fft.rfftfreq(length, recordings[0].sample_time)[keep], float)
    S = S[keep]
    averages = count / (1 + _CORRELATED * (count - 1) / count)
    try:
        to_reference = np.linalg.inv(S[:, at_u, at_r])
        inverse = np.linalg.inv(S[:, at_u, at_u])
    except np.linalg.LinAlgError:
        raise DataError(
            "the inputs do not excite independently at some frequency; record with independent inputs"
        ) from None
    response = S[:, at_y, at_r] @ to_reference
    explained = np.einsum("fyu,fuv,fyv->fy", S[:, at_y, at_u], inverse, S[:, at_y, at_u].conj()).real
    power = np.einsum("fyy->fy", S[:, at_y, at_y]).real
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.clip(explained / power, 0.0, 1.0)
    left, cost = power - np.clip(explained, 0.0, power), np.einsum("fuu->fu", inverse).real
    if closed:
        cross = response @ S[:, at_u, at_y]
        within = response @ S[:, at_u, at_u] @ response.conj().swapaxes(1, 2)
        left = np.maximum(power - 2 * np.einsum("fyy->fy", cross).real + np.einsum("fyy->fy", within).real, 0.0)
        cost = np.einsum("fru,frs,fsu->fu", to_reference.conj(), S[:, at_r, at_r], to_reference).real
    variance = left[:, :, None] * cost[:, None, :] / (2 * max(averages - n_u, 1.0))
    return f, response, np.sqrt(variance), coherence, averages


_PERIODS = 3  # fewest: the first has the transient, and one alone shows no noise
_MOVES = 5.0  # standard deviations of an input's amplitude, above which a line is excited
_OF_LARGEST = 1e-4  # part of the largest amplitude, below which a line is rounding
_FREEDOM = 40  # degrees of freedom of the power of the noise, for which neighbouring lines are taken together


def _of_periods(
    recordings: Sequence[Recording], u: Sequence[FloatArray], y: Sequence[FloatArray], period_s: float
) -> _Estimate:
    """Return the frequency response at the excited lines of a periodic excitation."""
    from scipy.ndimage import uniform_filter1d

    h, n_u = recordings[0].sample_time, u[0].shape[1]
    n = round(period_s / h)
    if n < 2 or abs(n * h - period_s) > 1e-6 * period_s:
        raise UsageError(f"period_s = {period_s:g}: it must be a whole number of samples of {h:g} s")
    n_c = n_u + y[0].shape[1]
    means, noise, freedom, periods = list[ComplexArray](), np.zeros((n // 2 - 1, n_c, n_c), complex), 0, 0
    for recording, u_columns, y_columns in zip(recordings, u, y, strict=True):
        count = len(u_columns) // n
        if count < _PERIODS:
            raise DataError(f"recording {recording.name!r} has {count} periods; record at least {_PERIODS}")
        whole = np.hstack([u_columns, y_columns])[n : count * n].reshape(count - 1, n, -1)
        lines = np.fft.rfft(whole, axis=1)[:, 1 : n // 2]
        means.append(lines.mean(axis=0))
        off = lines - means[-1]
        noise = noise + np.einsum("pfa,pfb->fab", off, off.conj())
        freedom, periods = freedom + count - 2, periods + count - 1
    width = -(-_FREEDOM // (2 * freedom))
    S = uniform_filter1d(noise, 2 * width + 1, axis=0, mode="nearest") / (freedom * periods / len(recordings))
    mean = np.stack(means)  # recordings, lines, channels
    amplitude = np.abs(mean[:, :, :n_u]).max(axis=0)
    spread = np.sqrt(np.maximum(np.einsum("faa->fa", S[:, :n_u, :n_u]).real, 0.0))
    moving = amplitude > np.maximum(_MOVES * spread, _OF_LARGEST * amplitude.max(initial=0.0))
    chosen = np.flatnonzero(moving.any(axis=1))
    response = np.full((len(chosen), y[0].shape[1], n_u), np.nan, complex)
    variance = np.full(response.shape, np.nan)
    coherence = np.zeros((len(chosen), y[0].shape[1]))
    for place, line in enumerate(chosen):
        active = np.flatnonzero(moving[line])
        if len(active) > len(recordings):
            continue
        U, Y = mean[:, line, active].T, mean[:, line, n_u:].T
        H = Y @ np.linalg.pinv(U)
        equations = np.hstack([-H, np.eye(len(Y))])
        channels = np.ix_([*active, *range(n_u, mean.shape[2])], [*active, *range(n_u, mean.shape[2])])
        left = np.einsum("ya,ab,yb->y", equations, S[line][channels], equations.conj()).real
        response[place][:, active] = H
        variance[place][:, active] = np.outer(left, np.diag(np.linalg.pinv(U @ U.conj().T)).real) / 2
        power = (np.abs(Y) ** 2).sum(axis=1)
        coherence[place] = np.clip(1 - left * len(recordings) / np.maximum(power, np.finfo(float).tiny), 0.0, 1.0)
    if not np.isfinite(response).any():
        raise DataError(
            f"{len(recordings)} recordings do not separate the inputs at any line: make as many recordings "
            "as there are inputs, with different phases, or give each input different lines"
        )
    f = np.asarray((chosen + 1) / period_s, float)
    return f, response, np.sqrt(variance), coherence, float(periods)


def _segment_length(recordings: Sequence[Recording], resolution_hz: float | None) -> int:
    shortest = min(recordings, key=lambda recording: recording.n_samples)
    if resolution_hz is None:
        return max(16, 2 * (shortest.n_samples // (_SEGMENTS + 1)))
    length = max(8, round(1 / (resolution_hz * shortest.sample_time)))
    if length > shortest.n_samples:
        seconds = shortest.n_samples * shortest.sample_time
        raise DataError(
            f"recording {shortest.name!r} lasts {seconds:g} s, too short for resolution_hz = {resolution_hz:g}; "
            f"take at least {1 / seconds:.3g} Hz"
        )
    return length


def _spectra(records: Sequence[FloatArray], length: int) -> tuple[ComplexArray, int]:
    """Return mean spectral matrices (n_f, n, n) over all segments, and the number of segments."""
    window = np.hanning(length + 1)[:-1, None]
    total = np.zeros((length // 2 + 1, records[0].shape[1], records[0].shape[1]), complex)
    count = 0
    for record in records:
        for first in range(0, len(record) - length + 1, max(1, length // 2)):
            piece = record[first : first + length]
            transform = np.fft.rfft((piece - piece.mean(0)) * window, axis=0)
            total += transform[:, :, None] * transform[:, None, :].conj()
            count += 1
    return np.asarray(total / max(count, 1), complex), count


# ---- Delay between two signals, from the correlation of the output with the whitened input.

_ORDER = 30  # largest order of the whitening filter
_LEVEL = 4.0  # smallest correlation that counts, in standard deviations: by chance one in 16 000 lags


@dataclass(frozen=True, eq=False)
class DelayEstimate(Brief):
    """Delay from an input to an output, estimated by correlation.

    Attributes
    ----------
    delay_s : float
        Largest delay that the correlation allows [s]: the output has not begun to move before.
    lag : int
        First lag at which the output follows the input [samples]. An input that is held between samples reaches the
        next sample at the earliest, so that ``delay_s`` is ``lag - 1`` samples.
    lags : (n,) array
        Lags [samples].
    correlation : (n,) array
        Correlation of the whitened input with the output that was filtered in the same way. It has the shape of the
        impulse response.
    limit : float
        Absolute value above which a correlation counts.
    input_name, output_name : str
        Names of the channels.
    """

    delay_s: float
    lag: int
    lags: FloatArray
    correlation: FloatArray
    limit: float
    input_name: str
    output_name: str

    def _brief(self) -> Description:
        about = f"{self.input_name} to {self.output_name}, {self.delay_s:.6g} s ({self.lag - 1} samples)"
        return brief(self, about, lag=self.lag, limit=self.limit)


def estimate_delay(
    recording: Recording, input: str = "u", output: str = "y", *, longest_s: float | None = None
) -> DelayEstimate:
    """Return the delay from an input to an output, from the correlation of the output with the whitened input.

    Parameters
    ----------
    recording : Recording
        Recording in open loop, in which the input moves.
    input, output : str
        One signal or channel (``"p.x"``) each.
    longest_s : float, optional
        Longest delay that is looked for [s]; by default a tenth of the recording.

    Returns
    -------
    DelayEstimate
        Delay in whole samples. The delay lies in the sample that begins there, or earlier when the output begins so
        slowly that its beginning is lost in the noise. A fit with an exact delay (``B_delayed`` and ``delay``) gives
        the rest.

    Raises
    ------
    DataError
        When the recording lacks a signal or the output does not follow the input.
    UsageError
        When a name stands for several channels, or the longest delay is not positive.

    Notes
    -----
    An autoregression makes the input white, and the same filter is applied to the output. Their correlation is then the
    impulse response up to a factor (Box and Jenkins, Time Series Analysis, Sec. 11.2). Without a connection its
    standard deviation is one over the root of the number of samples.
    """
    (u, u_name), (y, y_name) = (_one_channel(recording, name) for name in (input, output))
    n = len(u)
    most = n // 10 if longest_s is None else round(longest_s / recording.sample_time)
    if most < 1 or most > n // 2:
        half = n * recording.sample_time / 2
        raise UsageError(f"longest_s = {longest_s}: choose between one sample and half of the recording, {half:g} s")
    order = min(_ORDER, n // 20)
    past = np.column_stack([u[order - i : n - i] for i in range(1, order + 1)])
    weights = np.linalg.lstsq(past, u[order:], rcond=1e-8)[0]
    white = u[order:] - past @ weights
    follow = y[order:] - np.column_stack([y[order - i : n - i] for i in range(1, order + 1)]) @ weights
    white, follow = white - white.mean(), follow - follow.mean()
    size = float(np.linalg.norm(white) * np.linalg.norm(follow))
    if size == 0:
        raise DataError(f"recording {recording.name!r}: {u_name!r} or {y_name!r} does not move")
    correlation = np.array([white[: len(white) - k] @ follow[k:] for k in range(most + 1)]) / size
    limit = _LEVEL / np.sqrt(len(white))
    above = np.flatnonzero(np.abs(correlation) > limit)
    if not len(above):
        raise DataError(
            f"recording {recording.name!r}: {y_name!r} does not follow {u_name!r} within "
            f"{most * recording.sample_time:g} s; look further (longest_s), or excite more"
        )
    lag = int(above[0])
    return DelayEstimate(
        delay_s=max(lag - 1, 0) * recording.sample_time,
        lag=lag,
        lags=np.arange(most + 1, dtype=float),
        correlation=correlation,
        limit=float(limit),
        input_name=u_name,
        output_name=y_name,
    )


def _one_channel(recording: Recording, name: str) -> tuple[FloatArray, str]:
    values, labels, _ = select(recording, (name,))
    if len(labels) != 1:
        raise UsageError(f"{name!r} has {len(labels)} channels, {', '.join(labels)}; name one, as '{name}.x'")
    return values[:, 0] - values[:, 0].mean(), labels[0]
