"""Files of a control chain: C source, header, self-test, S-function and notes."""

from __future__ import annotations

from pathlib import Path

from gbid.atomic import atomic_path
from gbid.errors import UsageError
from gbid.files.text_checksum import with_text_checksum
from gbid.naming.paths import given_path
from gbid.target.chain import Chain
from gbid.target.emulated import run_emulated
from gbid.target.selftest_rows import FLOAT_TOLERANCE, selftest_rows
from gbid.target.source import render_source

_FILES = {
    ".h": "chain.h.j2",
    ".c": "chain.c.j2",
    "_selftest.c": "chain_selftest.c.j2",
    "_sfun.c": "chain_sfun.c.j2",
    "_notes.md": "chain_notes.md.j2",
}
_UNMEASURED = "Instructions per sample: not counted (gbid export --measure counts them on an emulated Cortex-M4F)."


def write_chain(chain: Chain, folder: str | Path, *, measure: bool = False, overwrite: bool = False) -> list[Path]:
    """Write a control chain as C source, and return the paths of the files.

    Parameters
    ----------
    chain : Chain
        The chain, from `chain_of`.
    folder : str or path
        Folder of the files. Their names begin with the name of the chain.
    measure : bool
        Whether the source is compiled for a Cortex-M4F and run under an emulator: then the header has the instructions
        per sample. It needs arm-none-eabi-gcc and qemu-system-arm.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of pathlib.Path
        Header, source, self-test, S-function and notes.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or when a program is missing for `measure`.
    DataError
        When a file cannot be written.
    """
    folder = given_path(folder)
    paths = {folder / f"{chain.name}{ending}": template for ending, template in _FILES.items()}
    for path in paths:
        if path.exists() and not overwrite:
            raise UsageError(f"{path} exists already; choose another name or ask for overwriting")
    rows = selftest_rows(chain)
    measured: tuple[str, ...] = (_UNMEASURED,)
    if measure:
        run = run_emulated(chain, rows)
        if run.wrong_row:
            raise UsageError(
                f"chain {chain.name!r}: row {run.wrong_row} of its self-test differs on the emulated Cortex-M4F; "
                "please report it"
            )
        measured = run.lines()
    for path, template in paths.items():
        text = render_source(
            template,
            chain,
            rows=rows,
            n_rows=len(rows),
            tolerance=FLOAT_TOLERANCE * chain.options.limit_m,
            measured=measured,
            conditions=_conditions(chain),
        )
        with atomic_path(path, overwrite) as part:
            part.write_bytes(with_text_checksum(text, path.suffix).encode("ascii"))
    return list(paths)


def _conditions(chain: Chain) -> str:
    """Return the operating points of the maps in words."""
    points = [each.conditions for each in chain.maps]
    words = [
        ", ".join(f"{c[key]:g} {unit}" for key, unit in (("pressure_bar", "bar"), ("speed_rpm", "rpm")) if key in c)
        for c in points
    ]
    return " and at ".join(word for word in words if word)
