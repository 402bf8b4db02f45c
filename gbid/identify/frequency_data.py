"""Frequency responses with standard deviations as data of a fit, also from files of analysers and python-control."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Pictured
from gbid.core.option_types import checks_arguments
from gbid.core.tables import Column, Table
from gbid.identify.uncertainty.curves import ChannelCurves
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
        for field, value in made.items():
            object.__setattr__(self, field, value)

    def _brief(self) -> Description:
        about = f"{self.name}, {len(self.frequency_hz)} frequencies"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    def table(self) -> Table:
        """Return the numbers as a table, with a row for each output, input and frequency; `read` reads its CSV."""
        numbers = self._numbers()
        columns = [Column("output"), Column("input"), *(Column(name, format=8) for name in ("frequency_hz", *numbers))]
        return Table(self._title, columns, self._rows(self.frequency_hz, *numbers.values()))

    def _numbers(self) -> dict[str, FloatArray]:
        """Return the columns of the table after that of the frequency, each (n, n_outputs, n_inputs)."""
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
        responses = getattr(format_of_ending(path.suffix.lower()), "responses", None)
        try:
            pairs, coherent = responses(path) if responses else _of_csv(path, std is None)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
        except DataError:
            raise
        except (ValueError, TypeError, AttributeError) as error:
            raise DataError(f"{path}: is no table of a frequency response: {error}") from None
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
        return cls(f, response, inputs=inputs, outputs=outputs, averages=averages, name=path.stem, **quality)

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
        """Return the responses between these channels, in this order.

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
                "say with reference what excites this loop"
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
            moved = f"{', '.join(reference)} do not move {', '.join(inputs)} independently"
            raise DataError(f"frequency response {self.name!r}: {moved}") from None
        G = to_y.response[known] @ inverse
        variance = (to_y.std[known] ** 2 + np.abs(G) ** 2 @ to_u.std[known] ** 2) @ np.abs(inverse) ** 2
        names = to_u.output_names, to_y.output_names
        options: dict[str, Any] = {"correlation": self.correlation, "name": self.name, "of_loop": True}
        return FrequencyData(self.frequency_hz[known], G, np.sqrt(variance), None, *names, **options)


_SUFFIX = {"Hz": "_hz", "dB": "_db", "deg": "_deg", "°": "_deg"}
"""Ends of the names of columns by their units, so that ``Phase [°]`` is ``phase_deg``; others are not looked at."""
_HEADER_LINES = 200  # within which the header line is looked for


def _names(line: str) -> tuple[list[str], str]:
    """Return the names of columns in a line of a CSV file, and the character between them."""
    delimiter = max(",;\t", key=line.count)
    headings = [name_and_unit(cell.strip()) for cell in next(csv.reader([line], delimiter=delimiter), [])]
    return [name.lower() + _SUFFIX.get(unit or "", "") for name, unit in headings], delimiter


def _of_csv(path: Path, needs_spread: bool) -> tuple[dict[tuple[str, str], PairResponse], bool]:
    """Return the responses in a CSV file by output and input, and whether their quality is the coherence.

    The header line is the first one with the frequency. Numbers have a decimal comma where no comma is between them.
    """
    lines = read_text(path).text.splitlines()
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
    """Return values that broadcast to a shape (n, n_outputs, n_inputs); (n,) and (n, n_outputs) are for all inputs."""
    array = np.asarray(values, float)
    if 0 < array.ndim < len(shape):
        array = array.reshape(*array.shape, *[1] * (len(shape) - array.ndim))
    try:
        np.broadcast_shapes(array.shape, shape)
    except ValueError:
        raise UsageError(f"{what} has the shape {array.shape}; responses have {shape}") from None
    return array


def _places(names: Sequence[str], wanted: Sequence[str], source: str) -> list[int]:
    """Return the places of channels, or of all channels of a signal, among names."""
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
