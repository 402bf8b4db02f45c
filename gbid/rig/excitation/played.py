"""Given signal as references, such as a designed excitation or the file of a signal generator."""

from __future__ import annotations

import hashlib
from dataclasses import InitVar, dataclass, field

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.excitation.prbs import whole_samples


@dataclass(frozen=True)
class Played:
    """Given references, played from the first sample of the recording.

    Before it, while the motion settles, the end of the signal is faded in. So a periodic signal is in its steady state
    when the recording begins, and no step excites more than the signal itself.

    Parameters
    ----------
    samples : (n_samples, 2) array
        References r of x and y [m].
    sample_time : float
        Time between samples [s], that of the rig.
    source : str
        Where the signal comes from, for the provenance.

    Attributes
    ----------
    sha256 : str
        Digest of the samples, which stands for them in the provenance.

    Raises
    ------
    UsageError
        When the samples are not finite numbers of two axes.
    """

    samples: InitVar[npt.ArrayLike]
    sample_time: float
    source: str = "given"
    sha256: str = field(init=False)

    def __post_init__(self, samples: npt.ArrayLike) -> None:
        values = np.array(samples, dtype=float)
        if values.ndim != 2 or values.shape[1] != 2 or not len(values) or not np.isfinite(values).all():
            raise UsageError(f"played: samples of shape {values.shape}; give (n_samples, 2) finite numbers, x and y")
        values.setflags(write=False)
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "sha256", hashlib.sha256(values.tobytes()).hexdigest())

    @property
    def values(self) -> FloatArray:
        """References r, (n_samples, 2) [m]."""
        found: FloatArray = self.__dict__["_values"]
        return found

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return len(self.values) * self.sample_time

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, shape (n_samples, 2) [m].

        Raises
        ------
        UsageError
            When the rig has another sample time.
        """
        del random
        if abs(sample_time - self.sample_time) > 1e-9 * sample_time:
            raise UsageError(
                f"played: the signal has a sample every {self.sample_time:g} s, the rig every {sample_time:g} s; "
                "design it for the sample time of the rig"
            )
        whole_samples("played: duration_s", self.duration_s, sample_time)
        at = np.arange(n_samples) - n_settle
        faded = np.where(at < 0, np.sin(np.pi / 2 * (at + n_settle) / max(n_settle, 1)) ** 2, 1.0)
        return np.asarray(self.values[at % len(self.values)] * faded[:, None])
