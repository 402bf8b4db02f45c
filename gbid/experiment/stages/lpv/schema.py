"""Schema of the lpv section."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field, Strict

from gbid.experiment.fields import Name, Section, Switch, Text

Term = Literal["1", "P", "Omega", "Omega P", "P^2", "Omega^2"]


def _order(value: Any) -> Any:
    """Return the order; refuse any other value with one message for all three forms."""
    terms = get_args(Term)
    listed = isinstance(value, list | tuple) and value and all(term in terms for term in value)
    if not listed and value != "auto" and (type(value) is not int or value not in (0, 1, 2)):
        words = ", ".join(f'"{term}"' for term in terms)
        raise ValueError(f"expected 0, 1, 2, auto, or a list of terms out of {words}; found {value!r}")
    return value


class LpvSection(Section):
    """Surfaces of the key parameters of a fit to each recording (paper, Eq. 16); see `gbid.fit_lpv`.

    `actuators`: the word ``nominal`` (choice of the section nominal), or the name or file of a model; default none.
    `direct`: whether the surfaces are also estimated directly from the recordings; see `gbid.fit_lpv_direct`.
    """

    fit: Name
    weighting: Literal["scatter", "fits", "ordinary"] = "scatter"
    order: Annotated[
        Annotated[int, Strict(), Field(ge=0, le=2)] | Literal["auto"] | tuple[Term, ...], BeforeValidator(_order)
    ] = 2
    robust: Switch = False
    direct: Switch = False
    actuators: Text | None = None
