"""Export of a sampled controller as C source for a real-time target."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

from gbid.arrays import FloatArray
from gbid.atomic import atomic_path
from gbid.errors import UsageError
from gbid.structure import LinearModel


def export_c(
    path: str | Path,
    controller: LinearModel,
    *,
    limit_m: float = 22.5e-6,
    number: str = "double",
    overwrite: bool = False,
) -> tuple[Path, Path]:
    """Write a sampled controller as C source, and return the paths of source and header.

    The source has a struct of the states, a reset function and a step function with saturation.

    Parameters
    ----------
    path : str or path
        The source file, ending in .c. Its name without the ending must be a C identifier and is the prefix of all names
        in it. The header is written beside it.
    controller : LinearModel
        Sampled controller, from `gbid.control.sample_controller` or `ControllerDesign.sampled_at`.
    limit_m : float
        Limit of the magnitude of each output [m]: the travel of a piezo stack to each side.
    number : {"double", "float"}
        Type of all numbers.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    tuple of pathlib.Path
        Source and header.

    Raises
    ------
    UsageError
        When the controller is continuous, when the limit is not positive, when the ending or name is wrong, or when the
        files exist.
    DataError
        When the files cannot be written.

    Notes
    -----
    The step function computes the outputs from the new positions before it updates the states, so that the outputs are
    available early. The states do not depend on the outputs, so saturation causes no wind-up. The code allocates no
    memory, calls no library and has no global variables.
    """
    source = Path(path)
    header = source.with_suffix(".h")
    if source.suffix != ".c" or not source.stem.isidentifier():
        raise UsageError(f"{source}: give a file whose name is a C identifier and ends in .c")
    if controller.dt is None:
        raise UsageError(f"model {controller.name!r} is continuous; sample it first with sample_controller")
    if not (isfinite(limit_m) and limit_m > 0):
        raise UsageError(f"export of {controller.name!r}: limit_m = {limit_m}; give a positive number of metres")
    if number not in ("double", "float"):
        raise UsageError(f"export of {controller.name!r}: number = {number!r}; choose 'double' or 'float'")
    if not overwrite:
        for file in (source, header):
            if file.exists():
                raise UsageError(f"{file} exists; choose another name or overwrite=True")
    with atomic_path(header, overwrite) as part:
        part.write_text(_header(source.stem, controller, number), encoding="utf-8")
    with atomic_path(source, overwrite) as part:
        part.write_text(_source(source.stem, controller, number, limit_m), encoding="utf-8")
    return source, header


def _header(name: str, model: LinearModel, number: str) -> str:
    n, (n_r, n_p) = model.n_states, model.D.shape
    return f"""/* {_comment(model.name)}: sampled at {model.dt!r} s, written by gbid.
   r = K p, the output is added to the plant's input as it is (positive feedback).
   p: {_comment(", ".join(model.input_names))} [m]; r: {_comment(", ".join(model.output_names))} [m]. */
#ifndef {name.upper()}_H
#define {name.upper()}_H

typedef struct {{ {number} x[{max(n, 1)}]; }} {name}_state;

/* At rest. */
void {name}_reset({name}_state *state);

/* One sample: positions in, references out, held within the travel of the piezos. */
void {name}_step({name}_state *state, const {number} p[{n_p}], {number} r[{n_r}]);

#endif
"""


def _source(name: str, model: LinearModel, number: str, limit: float) -> str:
    n, (n_r, n_p) = model.n_states, model.D.shape
    suffix = "f" if number == "float" else ""
    outputs = [f"    value = {_sum(model.C[i], model.D[i], suffix)};\n    r[{i}] = clip(value);" for i in range(n_r)]
    states = [f"    next[{i}] = {_sum(model.A[i], model.B[i], suffix)};" for i in range(n)]
    declared = f"    {number} value;" + (f"\n    {number} next[{n}];\n    int i;" if n else "")
    advance = [*states, f"    for (i = 0; i < {n}; ++i) state->x[i] = next[i];"] if n else ["    (void)state;"]
    body = "\n".join([declared, "", *outputs, "", *advance])
    return f"""#include "{name}.h"

static const {number} limit = {_literal(limit, suffix)};

static {number} clip({number} value)
{{
    return value > limit ? limit : (value < -limit ? -limit : value);
}}

void {name}_reset({name}_state *state)
{{
    int i;
    for (i = 0; i < {max(n, 1)}; ++i) state->x[i] = 0;
}}

void {name}_step({name}_state *state, const {number} p[{n_p}], {number} r[{n_r}])
{{
{body}
}}
"""


def _sum(states: FloatArray, inputs: FloatArray, suffix: str) -> str:
    terms = [f"{_literal(c, suffix)} * state->x[{j}]" for j, c in enumerate(states) if c != 0.0]
    terms += [f"{_literal(c, suffix)} * p[{j}]" for j, c in enumerate(inputs) if c != 0.0]
    return " + ".join(terms) or "0"


def _literal(value: float, suffix: str) -> str:
    """Return a number as a C literal that has the same bits."""
    text = repr(float(value))
    text = text if any(c in text for c in ".e") else f"{text}.0"
    return f"({text}{suffix})" if value < 0 else f"{text}{suffix}"


def _comment(text: str) -> str:
    return text.replace("*/", "* /").replace("\n", " ")
